"""Named pipes in place of the files that commands read: one line, without waiting for a writer."""

import os

import numpy as np
import pytest

from mimic.commands.collect.finished_runs import find_runs
from mimic.runs.checkpoints import load_training, save_checkpoint
from mimic.runs.sweeps.sweeper import SWEEP
from mimic.trainers.run_config import load_config
from tests.helpers.run_directories import write_run

pytestmark = pytest.mark.usefixtures("in_time")
PLANAR = "env=planar4dof"
# A key of each command that names a file or a folder; the readers themselves are tested in tests/base/test_files.py.
KEYS = [
    ("train", "env.learner.model", ".xml"),
    ("train", "env.demonstrations.path", ".npz"),
    ("evaluate", "run", ""),
    ("export", "run", "", "out=policy.onnx"),
    ("render", "run", ""),
    ("dataset", "demonstrations", ".npz", "out=dataset"),
    ("collect", "folder", ""),
    ("demonstrations", "source", ".db3", "out=d.npz"),
    ("retarget", "demonstrations", ".npz", "out=out.npz"),
    ("inspect", "clip", ".trc"),
    ("view", "source", ".csv"),
]


@pytest.mark.parametrize("case", KEYS, ids=lambda case: " ".join(case))
@pytest.mark.usefixtures("unchecked")
def test_a_pipe_for_a_key(reason, tmp_path, case):
    command, key, suffix, *others = case
    os.mkfifo(tmp_path / f"pipe{suffix}")
    error = reason(
        command, f"{key}={tmp_path}/pipe{suffix}", *others, *([PLANAR] if command in ("train", "retarget") else [])
    )
    assert f"pipe{suffix}" in error


@pytest.mark.parametrize("name", ["config.yaml", "report.json", "metrics.csv", "plugins.json", "models", SWEEP])
def test_a_pipe_in_a_run_directory(tmp_path, name):
    run_dir = write_run(tmp_path / "run", [0.5, 0.3])
    (run_dir / name).unlink(missing_ok=True)
    os.mkfifo(run_dir / name)
    if name == "config.yaml":
        with pytest.raises(ValueError, match="is not a run directory: it has no config.yaml"):
            load_config(run_dir)
    finished, left_out = find_runs(tmp_path)
    assert len(finished) + len(left_out) <= 1
    if name == "report.json":
        assert left_out[0].reason == "report.json cannot be read: expected a regular file, got a named pipe"


@pytest.mark.parametrize("name", ["params.npz", "checkpoint.json", "training.npz"])
def test_a_pipe_in_a_checkpoint(tmp_path, name, capsys):
    params = {"kernel": np.zeros((2, 3), np.float32)}
    for step in (0, 10):
        save_checkpoint(tmp_path, step, params, [np.arange(4)])
    file = tmp_path / "checkpoints" / "000000000010" / name
    file.unlink()
    os.mkfifo(file)
    checkpoint = load_training(tmp_path, params)
    if name == "training.npz":  # the state is optional
        assert checkpoint.step == 10 and checkpoint.state is None
    else:
        assert checkpoint.step == 0 and capsys.readouterr().err.count("\n") == 1
