"""`python -m mimic.train`: the run directory, evaluation, resuming and signals."""

import contextlib
import dataclasses
import json
import logging
import os
import re
import resource
import shutil
import signal
import time

import imageio_ffmpeg
import jax
import numpy as np
import pytest

from mimic.runs.checkpoints import checkpoint_steps, delete_checkpoint, load_checkpoint, save_checkpoint
from mimic.runs.lock import RunLock
from mimic.trainers.config import TrainConfig
from mimic.trainers.make import make_ppo_trainer
from mimic.trainers.run_config import load_config, new_run_dir
from mimic.trainers.run_training import _memory_errors, prepare_training
from tests.helpers.commands import command, run, start, wait_for
from tests.helpers.run_directories import rows_of
from tests.helpers.tiny import ENDLESS, TINY

BY_SPLIT = {
    "optimality_gap", "mean_distance", "lower_bound", "hold_distance", "link_angle_error_deg", "angular_velocity_error",
    "torque_rms", "torque_change", "torque_saturation", "position_violations", "speed_violations", "torque_violations",
    "worst_demonstrations",
}  # fmt: skip
REPORT_KEYS = {"env", "trainer", "seed", "wall_time_s", "env_steps", "steps_per_second", "hardware", "versions"}

TIMES = {"wall_time_s", "training/sps", "training/walltime"}


def state_of(run_dir):
    """The training's state in the last checkpoint, and the metrics except for times."""
    last = max(path for path in (run_dir / "checkpoints").iterdir() if path.name.isdigit())
    with np.load(last / "training.npz") as file:
        state = {f"{last.name}/{name}": file[name] for name in file.files}
    metrics = ({f"{row['step']}/{key}": row[key] for key in row.keys() - TIMES} for row in rows_of(run_dir))
    return state | {key: value for row in metrics for key, value in row.items()}


def differences(reference, run_dir):
    """Names of what differs between the ends of two runs."""
    expected, actual = state_of(reference), state_of(run_dir)
    common = expected.keys() & actual.keys()
    unequal = {name for name in common if not np.array_equal(expected[name], actual[name])}
    return unequal | (expected.keys() ^ actual.keys())


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """One tiny run, what it prints, and what it compiles."""
    run_dir = tmp_path_factory.mktemp("runs") / "tiny"
    compiled, handler = [], logging.Handler()
    handler.emit = lambda record: compiled.append(record.getMessage())
    logging.getLogger("jax").addHandler(handler)
    jax.config.update("jax_log_compiles", True)  # in all threads
    try:
        printed = run("train", *TINY, f"run_dir={run_dir}", "compilation_cache=")
    finally:
        jax.config.update("jax_log_compiles", False)
        logging.getLogger("jax").removeHandler(handler)
    return run_dir, printed, "\n".join(compiled)


def test_a_run_directory_holds_everything(finished):
    run_dir, *_ = finished
    names = {path.name for path in run_dir.iterdir()}
    assert {"config.yaml", "report.json", "metrics.csv", "demonstrations.npz", "checkpoints", "tensorboard"} <= names
    report = json.loads((run_dir / "report.json").read_text())
    assert report.keys() >= REPORT_KEYS | BY_SPLIT
    for key in BY_SPLIT:
        assert report[key].keys() == {"train", "held_out"}
    assert {"demonstrations.csv", "quality.png", "demonstrations.png", "training.png"} <= names
    assert report["wall_time_s"].keys() == {"import", "build", "compile", "train", "evaluate", "total"}
    assert report["env_steps"] >= 5000
    assert report["physics"] == load_config(run_dir).env.physics == "fused"
    assert len((run_dir / "metrics.csv").read_text().splitlines()) == 1 + 4


def test_the_report_has_the_gap_on_mjx_too(finished):
    """1e-3: the joint angles of both differ by 1e-4 rad after 5 s, and the distance is of that order."""
    run_dir, printed, _ = finished
    report = json.loads((run_dir / "report.json").read_text())
    lines = printed.splitlines()
    assert lines[1] == (
        "physics: fused (auto: it covers the learner exactly); the report evaluates the policy on MJX too"
    )
    for key in ("optimality_gap", "mean_distance"):
        assert report["mjx"][key] == pytest.approx(report[key], rel=1e-3)
    assert "evaluated on MJX" in printed


def test_a_run_compiles_few_functions(finished):
    """Each takes a tenth of a second or more on a GPU."""
    names = re.findall(r"Compiling jit\((\w+)\) with global shapes and types", finished[2])
    for function in ("start", "epoch", "rollouts", "rollouts_on_mjx", "closest"):
        assert names.count(function) == 1
    assert len(names) < 24  # five for the poses where the learner starts; 54 with brax's own training loop


@pytest.mark.slow
def test_evaluate_repeats_the_report(finished, tmp_path):
    run_dir, *_ = finished
    out = tmp_path / "again"
    result = command("evaluate", f"run={run_dir}", f"out={out}")
    assert result.returncode == 0, result.stderr[-2000:]
    pictures = {"quality.png", "demonstrations.png", "similarity.png"}
    tables = {"demonstrations.csv", "quality.csv", "config.yaml"}
    assert {path.name for path in out.iterdir()} == {"report.json", *tables, *pictures}
    again, report = (json.loads((folder / "report.json").read_text()) for folder in (out, run_dir))
    for key in BY_SPLIT - {"worst_demonstrations"}:
        assert again[key] == pytest.approx(report[key], rel=1e-5)  # float32, in another process
    for key, values in report["mjx"].items():
        assert again["mjx"][key] == pytest.approx(values, rel=1e-5)
    for split, gaps in report["worst_demonstrations"].items():
        assert again["worst_demonstrations"][split] == pytest.approx(gaps, rel=1e-5)


@pytest.mark.slow
def test_a_video_shows_the_whole_motion(finished):
    run_dir, *_ = finished
    result = command("render", f"run={run_dir}", "demonstration=1")
    assert result.returncode == 0, result.stderr[-2000:]
    video = run_dir / "videos" / "held_out-1.mp4"
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(video))
    assert frames == 151 and seconds == pytest.approx(5, abs=0.1)  # 5 s at 30 frames a second, both ends
    beyond = command("render", f"run={run_dir}", "demonstration=2")
    assert beyond.returncode == 2 and "expected 0 to 1, the held_out ones of the run, got 2" in beyond.stderr


@pytest.mark.slow
def test_a_resumed_run_ends_as_if_it_had_not_been_interrupted(finished, tmp_path):
    """As after a SIGKILL while a checkpoint was written, one before the report, and with a damaged last checkpoint."""
    reference, *_ = finished
    run_dir = shutil.copytree(reference, tmp_path / "run")
    last = max(checkpoint_steps(run_dir))
    delete_checkpoint(run_dir, last)
    (run_dir / "checkpoints" / f"{last:012d}.partial").mkdir()
    for is_damaged in (False, False, True):
        if is_damaged:
            state = run_dir / "checkpoints" / f"{last:012d}" / "training.npz"
            state.write_bytes(state.read_bytes() + b"0")
        (run_dir / "report.json").unlink()
        result = command("train", f"resume={run_dir}")
        assert result.returncode == 0, result.stderr[-2000:]
        assert ("is damaged" in result.stderr) == is_damaged and not differences(reference, run_dir)
        assert json.loads((run_dir / "report.json").read_text())["env_steps"] == last
    assert not list((run_dir / "checkpoints").glob("*.partial*"))


def test_a_folder_without_a_config_is_no_run_yet(tmp_path):
    """A process that was killed before it wrote the config."""
    config = TrainConfig(run_dir=str(tmp_path))
    for name in ("demonstrations.npz", "config.yaml.partial", ".lock"):
        (tmp_path / name).touch()
    assert new_run_dir(config) == tmp_path
    (tmp_path / "notes.txt").touch()
    with pytest.raises(ValueError, match="exists"):
        new_run_dir(config)


@pytest.mark.slow
def test_a_run_starts_from_the_parameters_of_another_run(finished, tmp_path):
    run_dir = tmp_path / "run"
    result = command("train", *TINY, "seed=1", "trainer.evaluations=1", f"init={finished[0]}", f"run_dir={run_dir}")
    assert result.returncode == 0, result.stderr[-2000:]
    with np.load(finished[0] / "checkpoints" / f"{max(checkpoint_steps(finished[0])):012d}" / "training.npz") as file:
        policy = file["arr_0"]
    with np.load(run_dir / "checkpoints" / f"{0:012d}" / "training.npz") as file:
        np.testing.assert_array_equal(file["arr_0"], policy)
    other = command("train", "env=panda3dof", f"init={finished[0]}", f"run_dir={tmp_path / 'other'}")
    assert other.returncode == 2 and "init: expected a run of env.expert.model=panda" in other.stderr


@pytest.mark.slow
def test_a_run_without_a_state_is_resumed_from_its_parameters(finished, tmp_path):
    """No row of metrics.csv is lost; a line says what starts anew."""
    run_dir = shutil.copytree(finished[0], tmp_path / "run")
    for step in checkpoint_steps(run_dir):
        (run_dir / "checkpoints" / f"{step:012d}" / "training.npz").unlink(missing_ok=True)
    before = rows_of(run_dir)
    result = command("train", f"resume={run_dir}", "trainer.num_timesteps=8000")
    assert result.returncode == 0, result.stderr[-2000:]
    assert "optimizer and environments start anew" in result.stderr
    assert rows_of(run_dir)[: len(before) - 1] == before[:-1]  # the last one is evaluated again
    assert len(rows_of(run_dir)) > len(before)


@pytest.mark.slow
def test_a_run_without_a_checkpoint_starts_anew_and_keeps_its_init(finished, tmp_path):
    run_dir = tmp_path / "run"
    result = command("train", *TINY, "trainer.evaluations=1", f"init={finished[0]}", f"run_dir={run_dir}")
    assert result.returncode == 0, result.stderr[-2000:]
    again = shutil.copytree(run_dir, tmp_path / "again")
    shutil.rmtree(again / "checkpoints")
    (again / "report.json").unlink()
    (again / "metrics.csv").write_text("step,quality/opti")  # half of a header
    assert command("train", f"resume={again}").returncode == 0
    assert not differences(run_dir, again)


def test_a_folder_that_another_process_has_taken_is_not_written(finished, tmp_path):
    """Between the check of a new run and its start."""
    config = dataclasses.replace(load_config(finished[0]), run_dir=str(tmp_path / "run"))
    work = prepare_training(config, time.perf_counter())
    shutil.copytree(finished[0], tmp_path / "run")
    before = (tmp_path / "run" / "report.json").read_bytes()
    assert work() == 2
    assert (tmp_path / "run" / "report.json").read_bytes() == before


@pytest.mark.slow
def test_a_full_disk_is_one_line(finished, tmp_path):
    limit = 30_000  # bytes of a file: less than a checkpoint
    run_dir = shutil.copytree(finished[0], tmp_path / "run")
    (run_dir / "report.json").unlink()
    before = checkpoint_steps(run_dir)
    result = command(
        "train",
        f"resume={run_dir}",
        "trainer.num_timesteps=20000",
        env={**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false"},  # it would keep truncated entries
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    assert result.returncode == 1 and result.stderr.count("\n") == 1, result.stderr[-3000:]
    line = result.stderr.rstrip()
    assert "File too large" in line and line.endswith(f"train resume={run_dir}")
    assert checkpoint_steps(run_dir) == before and not list(run_dir.glob("checkpoints/*.partial"))


@pytest.mark.slow
def test_a_report_that_cannot_be_written_is_one_line(finished, tmp_path):
    run_dir = shutil.copytree(finished[0], tmp_path / "run")
    (run_dir / "report.json").unlink()
    (run_dir / "report.json.partial").mkdir()
    result = command("train", f"resume={run_dir}")
    assert result.returncode == 1 and len(result.stderr.splitlines()) == 1 and "continue with: python" in result.stderr


def test_a_run_that_another_process_writes_is_not_resumed(finished):
    config = TrainConfig(resume=str(finished[0]), compilation_cache="")
    with contextlib.closing(RunLock(finished[0])), pytest.raises(ValueError) as error:
        prepare_training(config, time.perf_counter(), ["trainer.num_timesteps=8000"])
    assert f"is in use by process {os.getpid()} on" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.slow
def test_a_training_that_diverges_stops_and_keeps_its_checkpoints(finished, tmp_path):
    """It starts from a policy whose actions are beyond float32, although its parameters are not."""
    start, run_dir = tmp_path / "start", tmp_path / "run"
    start.mkdir()
    shutil.copy(finished[0] / "config.yaml", start)
    template = make_ppo_trainer(load_config(finished[0]), finished[0]).params_template()
    step, (statistics, policy, value) = load_checkpoint(finished[0], template)
    save_checkpoint(start, step, (statistics, jax.tree.map(lambda x: 1e30 * x, policy), value))
    result = command("train", *TINY, f"init={start}", f"run_dir={run_dir}")
    assert result.returncode == 3, result.stderr[-2000:]
    (line,) = result.stderr.splitlines()
    assert re.match(r"error: training diverged: \w+ is not finite after \d+ steps; the checkpoints before it", line)
    assert line.endswith(f" are kept in {run_dir}")
    assert checkpoint_steps(run_dir) == [0] and not (run_dir / "report.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_a_checkpoint_and_says_how_to_resume(number, tmp_path):
    run_dir = tmp_path / "stopped"
    process = start("train", *TINY, f"run_dir={run_dir}", *ENDLESS)
    # SIGINT as soon as there is something to lose, SIGTERM in the midst of training.
    wait_for(run_dir, "config.yaml" if number == signal.SIGINT else "checkpoints/0*[1-9]*", process)
    process.send_signal(number)
    out, error = process.communicate(timeout=120)
    assert process.returncode == 128 + number, error[-2000:]
    assert f"resume={run_dir}" in out.replace("\n", "") and "stopping at the next checkpoint" in error
    assert list((run_dir / "checkpoints").iterdir())


@pytest.mark.slow
def test_a_second_signal_leaves_no_partial_checkpoint(tmp_path):
    run_dir = tmp_path / "stopped"
    process = start("train", *TINY, f"run_dir={run_dir}", *ENDLESS)
    wait_for(run_dir, "config.yaml", process)
    for pause in (0.4, 0.0):
        process.send_signal(signal.SIGINT)
        time.sleep(pause)
    _, error = process.communicate(timeout=120)
    assert process.returncode == 128 + signal.SIGINT and error.splitlines()[1:] == ["stopped by SIGINT"], error
    assert all(path.name.isdigit() for path in run_dir.glob("checkpoints/*"))


def test_too_little_memory_is_one_line():
    message = "RESOURCE_EXHAUSTED: Out of memory allocating 17592186044416 bytes."
    with pytest.raises(OSError, match=f"smaller batches need less of: {message}$"), _memory_errors():
        raise jax.errors.JaxRuntimeError(f"{message}\nbuffers of XLA, on many lines")
    with pytest.raises(jax.errors.JaxRuntimeError), _memory_errors():
        raise jax.errors.JaxRuntimeError("INTERNAL: a defect")
