"""`python -m mimic.retarget`, from the outside."""

import subprocess
import sys

import numpy as np
import pytest

import mimic


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("demonstrations") / "expert.npz"
    env = mimic.make("planar4dof", demonstrations={"count": 3, "held_out": 1})
    env.demonstrations.save(path)
    return path


def retarget(*arguments, **more):
    command = [sys.executable, "-m", "mimic.retarget", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=280, check=False, **more)


def test_the_motions_load_and_do_not_jump(recorded, tmp_path):
    out = tmp_path / "learner.npz"
    result = retarget(f"demonstrations={recorded}", "learner=planar4dof", f"out={out}")
    assert result.returncode == 0, result.stderr[-2000:]
    assert "maximum jump" in result.stdout
    motions = mimic.load_demonstrations(out)
    env = mimic.make("planar4dof", demonstrations={"count": 1, "held_out": 1})
    motions.check_fits(env.learner, 0.1, 50)
    jumps = np.abs(np.diff(motions.qpos, axis=1))
    assert np.all(jumps <= env.learner.velocity_limit * 0.1 + 1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["learner=planar4dof"], "demonstrations: expected a file"),
        (["demonstrations={recorded}", "learner=planar4dof"], "out: expected a file"),
        (["demonstrations=missing.npz", "learner=planar4dof", "out=new.npz"], "no file"),
        (["demonstrations={recorded}", "learner=panda5dof", "out=new.npz"], "unknown environment 'panda5dof'"),
        (["demonstrations={recorded}", "learner=panda4dof", "out=new.npz"], "recorded with the joints"),
        (["demonstrations={recorded}", "learner=planar4dof", "out={recorded}"], "exists; name a new file"),
        (["demonstrations={recorded}", "learner=planar4dof", "out=no/new.npz"], "there is no folder"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(recorded, arguments, message, tmp_path):
    result = retarget(*(argument.format(recorded=recorded) for argument in arguments), cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1 and message in result.stderr
    assert not list(tmp_path.iterdir())
