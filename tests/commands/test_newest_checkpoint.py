"""The newest checkpoint of a training: each is evaluated once, also while another process writes and removes them."""

import re
import signal
import socket
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from mimic.commands.newest_checkpoint import NewestCheckpoint
from mimic.runs.checkpoints import checkpoint_steps, delete_checkpoint, save_checkpoint
from mimic.runs.files import write_report
from mimic.runs.metrics_log import METRICS
from tests.helpers.tiny import TINY
from tests.helpers.untrained_run import untrained_run

ENOUGH = 30  # s for an evaluation, on a busy machine


@pytest.fixture
def trainer():
    """A trainer whose gap is its parameter."""
    return SimpleNamespace(
        unit="env_steps",
        total_steps=3000,
        params_template=lambda: np.zeros(1, np.float32),
        prepare_evaluation=lambda: None,
        evaluate=lambda params: float(params[0]),
        metrics=lambda rollouts: {"gap": rollouts},
        status=lambda metrics: f"gap {metrics['gap']:.1f}",
    )


@pytest.fixture
def newest(trainer, tmp_path, monkeypatch):
    monkeypatch.setattr("mimic.commands.newest_checkpoint._PERIOD", 0.0)
    newest = NewestCheckpoint(trainer, tmp_path)
    yield newest
    newest.finish()


def save(run_dir, step, gap):
    return save_checkpoint(run_dir, step, np.array([gap], np.float32))


def next_evaluation(newest):
    until = time.monotonic() + ENOUGH
    while time.monotonic() < until:
        if (evaluation := newest.advance()) is not None:
            return evaluation
        time.sleep(0.01)
    raise AssertionError("no new evaluation")


def contents(folder):
    """Every file and folder with its time and its content."""
    paths = sorted(folder.rglob("*"))
    return {path: (path.stat().st_mtime_ns, path.is_file() and path.read_bytes()) for path in (folder, *paths)}


def test_each_checkpoint_is_evaluated_once(newest, tmp_path):
    assert not newest.exists and newest.advance() is None
    save(tmp_path, 0, 1.0)
    assert newest.exists and next_evaluation(newest) == (1.0, "step 0 of 3,000: gap 1.0")
    for _ in range(5):
        assert newest.advance() is None
    save(tmp_path, 1000, 0.5)
    save(tmp_path, 2000, 0.25)
    assert next_evaluation(newest) == (0.25, "step 2,000 of 3,000: gap 0.2")  # the one before is out of date


def test_the_end_of_the_training_is_said(newest, tmp_path):
    save(tmp_path, 2000, 0.5)
    assert next_evaluation(newest).text == "step 2,000 of 3,000: gap 0.5"
    write_report(tmp_path, {"env_steps": 2000})  # it reached its target early
    assert next_evaluation(newest).text == "step 2,000, training ended: gap 0.5"
    assert newest.advance() is None and newest.advance() is None


def test_nothing_is_written(newest, tmp_path):
    save(tmp_path, 1000, 0.5)
    before = contents(tmp_path)
    next_evaluation(newest)
    assert contents(tmp_path) == before


def test_after_a_damaged_checkpoint_the_next_one_is_taken(newest, tmp_path):
    damaged = save(tmp_path, 1000, 0.5)
    (damaged / "_METADATA").write_text("{}")
    with pytest.raises(ValueError, match="checkpoint '.*1000' is damaged: _METADATA"):
        next_evaluation(newest)
    assert newest.advance() is None
    save(tmp_path, 2000, 0.25)
    assert next_evaluation(newest).rollouts == 0.25


def test_a_checkpoint_that_the_training_removes_meanwhile_is_skipped(newest, trainer, tmp_path):
    read = trainer.params_template

    def removed_meanwhile():
        if checkpoint_steps(tmp_path) == [1000]:
            delete_checkpoint(tmp_path, 1000)
            save(tmp_path, 2000, 0.25)
        return read()

    trainer.params_template = removed_meanwhile
    save(tmp_path, 1000, 0.5)
    assert next_evaluation(newest).rollouts == 0.25


def lines_of(process):
    assert process.stdout is not None
    for line in process.stdout:
        print(line, end="")
        yield line


def start_view(run_dir):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "mimic.view", f"run={run_dir}", "follow=true", f"port={port}"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_view_waits_for_the_first_checkpoint(tmp_path):
    pytest.importorskip("viser")
    run_dir = untrained_run(tmp_path / "run")
    (run_dir / "checkpoints").rename(tmp_path / "later")
    view = start_view(run_dir)
    try:
        lines = lines_of(view)
        assert next(lines).startswith("view: http://")
        assert next(lines) == f"view: {run_dir} has no checkpoint yet; waiting for the first one\n"
        (tmp_path / "later").rename(run_dir / "checkpoints")
        assert next(lines).startswith("view: step 0 of ")
    finally:
        view.send_signal(signal.SIGINT)
        assert view.wait(timeout=120) == 0


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_view_follows_a_training_in_another_process(tmp_path):
    pytest.importorskip("viser")
    run_dir, log = tmp_path / "run", tmp_path / "log"
    settings = [*TINY, "trainer.num_timesteps=400_000", "trainer.evaluations=50", "compilation_cache="]
    with log.open("w") as out:
        command = [sys.executable, "-m", "mimic.train", *settings, f"run_dir={run_dir}"]
        training = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
    while not (run_dir / "config.yaml").exists():
        assert training.poll() is None, log.read_text()
        time.sleep(0.05)
    view = start_view(run_dir)
    shown, untouched = {}, {}
    try:
        for line in lines_of(view):
            if match := re.search(r"step ([\d,]+)( of |, training ended).* gap ([-\d.]+)%, held out", line):
                shown[int(match[1].replace(",", ""))] = float(match[3])
                if "training ended" in line:
                    break
        assert training.wait(timeout=ENOUGH) == 0
        untouched = contents(run_dir)
        time.sleep(2.0)  # it goes on to look for checkpoints
    finally:
        view.send_signal(signal.SIGINT)
        assert view.wait(timeout=120) == 0
        training.kill()
    logged = np.genfromtxt(run_dir / METRICS, delimiter=",", names=True)
    gaps = dict(zip(logged["step"].astype(int), 100 * logged["qualityoptimality_gaptrain"], strict=True))
    assert len(shown) >= 3  # several while it trains
    for step in shown.keys() - {0}:  # the start is not logged
        assert shown[step] == pytest.approx(gaps[step], abs=0.06)  # a digit after the point is shown
    assert max(shown) == max(gaps) and contents(run_dir) == untouched
