"""`python -m mimic.demonstrations`: what it records, and what it rejects."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

import mimic
from mimic.commands.config import RecordingConfig
from mimic.commands.demonstrations import prepare_recording


def panda():
    return mimic.build_arm(mimic.ArmConfig())


@pytest.mark.slow_for("pd")
@pytest.mark.parametrize("kind", ["pd", pytest.param("reach", marks=pytest.mark.slow)])
def test_the_command_records_what_the_library_does(kind, tmp_path):
    out = tmp_path / "demonstrations.npz"
    command = [sys.executable, "-m", "mimic.demonstrations", f"kind={kind}", "count=3", "seed=5", f"out={out}"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    assert "all stay within the torque limits and velocity limits of panda" in result.stdout
    assert result.stdout.endswith(f"results: {out}\n")
    assert {path.name for path in tmp_path.iterdir()} == {"demonstrations.npz", "demonstrations.png"}
    loaded, expected = mimic.load_demonstrations(out), mimic.record_demonstrations(panda(), 3, kind=kind, seed=5)
    for field in dataclasses.fields(mimic.Demonstrations):
        np.testing.assert_array_equal(getattr(loaded, field.name), getattr(expected, field.name))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "out: expected a file"),
        (["out={taken}"], "exists; name a new file"),
        (["out=new.npz", "plot={taken}"], "exists; name a new file"),
        (["out=no/new.npz"], "there is no folder 'no'"),
        (["out=new.txt"], "expected a file that ends in .npz"),
        (["out=new.npz", "plot=new.txt"], "expected a file that ends in .png, .pdf, .svg"),
        (["out=new.npz", "kind=dance"], "expected one of pd, reach, got 'dance'"),
        (["out=new.npz", "count=0"], "count: expected a whole number from 1 to 100,000, got 0"),
        (["out=new.npz", "seed=-1"], "expected a whole number from 0 to 9,223,372,036,854,775,807, got -1"),
        (["out=new.npz", "limits=soft"], "expected one of none, hardware"),
        (["out=new.npz", "env=panda5dof"], "unknown env 'panda5dof'"),
        (["out=new.npz", "cuont=3"], "unknown key 'cuont'"),
    ],
)
def test_bad_input_of_the_command(rejected, tmp_path, arguments, message):
    taken = tmp_path / "taken.npz"
    taken.write_text("")
    assert message in rejected("demonstrations", *(argument.format(taken=taken) for argument in arguments))


def test_no_goal_within_the_limits_is_an_input_error(tmp_path):
    config = mimic.env_config("planar4dof", control_dt=0.9)
    with pytest.raises(ValueError, match="exceed its limits"):
        prepare_recording(RecordingConfig(config, count=1, out=str(tmp_path / "new.npz")))
