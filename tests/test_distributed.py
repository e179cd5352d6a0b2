"""Training over several processes: one run directory, and none is left behind however it ends."""

import json
import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import time

import pytest
from omegaconf import OmegaConf
from tiny import TINY

from mimic.trainers.group import DistributedConfig
from mimic.trainers.runs import run_schema

FUSED = [*TINY, "env.physics=fused"]


def start(tmp_path, *arguments, slurm=False):
    """Two processes of one training, each with a processor of its own as its device."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = []
    for index in range(2):
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        found = [f"distributed.coordinator=127.0.0.1:{port}", "distributed.processes=2", f"distributed.process={index}"]
        if slurm:  # what srun tells its tasks; JAX makes the port of the job's number
            found = ["distributed.coordinator=auto"]
            environment |= {"SLURM_JOB_ID": str(port), "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": "2"}
            environment |= {"SLURM_PROCID": str(index), "SLURM_LOCALID": str(index)}
        command = [sys.executable, "-m", "mimic.train", *FUSED, *found, *arguments]
        output = subprocess.PIPE
        process = subprocess.Popen(
            command, stdout=output, stderr=subprocess.STDOUT, text=True, env=environment, cwd=tmp_path
        )
        processes.append(process)
    return processes


def finish(processes):
    """Exit code and output of each; none may hang."""
    try:
        outputs = [process.communicate(timeout=280)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [(process.returncode, output) for process, output in zip(processes, outputs, strict=True)]


@pytest.mark.slow
def test_two_processes_make_one_run_that_another_number_goes_on_with(tmp_path):
    (first, shown), (second, silent) = finish(start(tmp_path, "run_dir=run"))
    assert (first, second) == (0, 0), shown[-2000:] + silent[-2000:]
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["env_steps"] >= 5000
    assert (report["hardware"]["devices"], report["hardware"]["processes"]) == (2, 2)
    assert len((tmp_path / "run" / "metrics.csv").read_text().splitlines()) == 1 + 4
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert "results: run" in shown and "results" not in silent
    # Another number of processes goes on with it; here, one.
    command = [sys.executable, "-m", "mimic.train", "resume=run", "trainer.num_timesteps=8000", "trainer.evaluations=1"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False, cwd=tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]
    assert json.loads((tmp_path / "run" / "report.json").read_text())["env_steps"] >= 8000


@pytest.mark.slow
def test_slurm_tells_all_that_is_needed(tmp_path):
    (first, shown), (second, silent) = finish(start(tmp_path, "run_dir=run", "trainer.evaluations=1", slurm=True))
    assert (first, second) == (0, 0), shown[-2000:] + silent[-2000:]
    assert json.loads((tmp_path / "run" / "report.json").read_text())["hardware"]["processes"] == 2


@pytest.mark.slow
def test_the_other_processes_end_with_the_first_where_it_is_good_enough(tmp_path):
    (first, shown), (second, silent) = finish(start(tmp_path, "run_dir=run", "trainer.target_gap=100"))
    assert (first, second) == (0, 0), shown[-2000:] + silent[-2000:]
    assert json.loads((tmp_path / "run" / "report.json").read_text())["env_steps"] < 5000


@pytest.mark.slow
def test_a_signal_to_one_process_stops_all_after_a_checkpoint(tmp_path):
    longer = "trainer.num_timesteps=100000000", "trainer.evaluations=20000"
    processes = start(tmp_path, "run_dir=run", *longer)
    until = time.monotonic() + 200
    while time.monotonic() < until and not list(tmp_path.glob("run/checkpoints/0*[1-9]*")):
        assert all(process.poll() is None for process in processes)
        time.sleep(0.2)
    processes[1].send_signal(signal.SIGTERM)
    (first, shown), (second, _) = finish(processes)
    assert (first, second) == (128 + signal.SIGTERM, 128 + signal.SIGTERM), shown[-2000:]
    assert "resume=run" in shown


@pytest.mark.slow
def test_a_process_that_is_refused_ends_the_others(tmp_path):
    (tmp_path / "run").mkdir()
    (first, shown), (second, silent) = finish(start(tmp_path, "run_dir=run"))
    assert first == 2 and "'run' exists" in shown
    assert second == 1 and "error: process 0 of the training failed" in silent


def test_the_page_shows_settings_that_exist():
    """Every override on it, with any value, is a key of the command."""
    page = (pathlib.Path(__file__).parent.parent / "docs" / "scaling.md").read_text()
    keys = set(re.findall(r"\b((?:trainer|distributed|env)\.\w+)=", page))
    config = run_schema("ppo")
    assert {"distributed.coordinator", "trainer.num_envs"} <= keys
    for key in keys:
        parent, _, name = key.rpartition(".")
        assert name in OmegaConf.select(config, parent), key


@pytest.mark.parametrize(
    "settings, reason",
    [
        ({"coordinator": "host"}, "expected HOST:PORT or auto, got 'host'"),
        ({"coordinator": "host:1", "processes": 2}, "distributed.process: expected a number"),
        ({"coordinator": "host:1", "process": 0}, "distributed.processes: expected a number"),
        ({"coordinator": "host:1", "processes": 2, "process": 2}, "distributed.process: expected 0 to 1, got 2"),
        ({"coordinator": "host:1", "processes": 0, "process": 0}, "distributed.processes: expected at least 1, got 0"),
        ({"process": 1}, "distributed.process: expected with distributed.coordinator=HOST:PORT alone, got 1"),
        ({"coordinator": "auto", "processes": 2}, "distributed.processes: expected with"),
    ],
)
def test_nonsense_is_refused(settings, reason):
    with pytest.raises(ValueError, match=reason):
        DistributedConfig(**settings)


def test_a_refusal_is_one_line(refused):
    number = ["distributed.processes=2", "distributed.process=2"]
    assert "expected 0 to 1, got 2" in refused("train", "distributed.coordinator=localhost:1", *number)


def test_a_sweep_in_step_is_refused(tmp_path):
    alone = ["distributed.coordinator=localhost:1", "distributed.processes=1", "distributed.process=0"]
    command = [sys.executable, "-m", "mimic.train", "-m", *alone, "seed=0,1"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False, cwd=tmp_path)
    assert result.returncode == 1
    assert len(re.findall("^failed: .*expected one run, got a sweep", result.stderr, re.MULTILINE)) == 2
