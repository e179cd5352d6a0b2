"""`python -m mimic.demonstrations`: what it records, and what it rejects."""

import dataclasses

import numpy as np
import pytest

import mimic
from mimic.commands.config import RecordingConfig
from mimic.commands.demonstrations import prepare_recording
from mimic.motions.demonstrations import FORMAT
from tests.helpers.commands import run


def panda():
    return mimic.build_arm(mimic.ArmConfig())


def test_the_command_records_what_the_library_does(tmp_path):
    out = tmp_path / "demonstrations.npz"
    printed = run("demonstrations", "kind=pid", "count=3", "seed=5", f"out={out}")
    assert "all stay within the torque limits and velocity limits of panda" in printed
    assert printed.endswith(f"results: {out}\n")
    assert {path.name for path in tmp_path.iterdir()} == {"demonstrations.npz", "demonstrations.png"}
    loaded, expected = mimic.load_demonstrations(out), mimic.record_demonstrations(panda(), 3, kind="pid", seed=5)
    for field in dataclasses.fields(mimic.Demonstrations):
        np.testing.assert_array_equal(getattr(loaded, field.name), getattr(expected, field.name))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["out={taken}"], "exists; name a new file"),
        (["out=new.txt"], "expected a file that ends in .npz"),
        (["out={folder}/drawn.npz"], "drawn.png' exists; name a new file"),
        (
            ["out=new.npz", "kind=dance"],
            "expected one of computed_torque, pid, reach, splines, steps, mixed, got 'dance'",
        ),
        (["out=new.npz", "count=0"], "count: expected a whole number from 1 to 100,000, got 0"),
        (
            ["out=new.npz", "source={folder}"],
            "expected a folder of a LeRobot dataset, of rosbag2 or HDF5 files, or of one table",
        ),
        (["out=new.npz", "arm=left"], "arm: expected none without source=FILE"),
        (["out=new.npz", "source={csv}", "capture.yaw=90"], "capture: expected none with a source of joint angles"),
        (
            ["out=new.npz", "source={recorded}"],
            "recorded.npz' has demonstrations in mimic's own format, which need no import; env.demonstrations.path=",
        ),
        (
            ["out=new.npz", "source={recorded}", "arm=left"],
            "expected points as names, positions, and time or rate, got demonstrations of an arm's joints",
        ),
        (["out=new.npz", "source={csv}", "topic=/a"], "topic: expected only for a LeRobot dataset, a rosbag2 or HDF5"),
        (["out=new.npz", "topic=/a"], "topic: expected none without source="),
        (["out=new.npz", "joints=[a]"], "joints: expected none without source=FILE"),
        (["out=new.npz", "seed=-1"], "expected a whole number from 0 to 9,223,372,036,854,775,807, got -1"),
    ],
)
def test_bad_input_of_the_command(reason, tmp_path, arguments, message):
    files = {"taken": "taken.npz", "csv": "motions.csv", "folder": "", "recorded": "recorded.npz"}
    paths = {name: tmp_path / file for name, file in files.items()}
    np.savez(paths["recorded"], format=FORMAT)
    paths["taken"].write_text("")
    (tmp_path / "drawn.png").write_text("")
    paths["csv"].write_text("time,joint1\n0,0\n")
    assert message in reason("demonstrations", *(argument.format(**paths) for argument in arguments))


def test_bad_input_is_one_line(rejected):
    assert "out: expected a file" in rejected("demonstrations")


def test_no_goal_within_the_limits_is_an_input_error(tmp_path):
    config = mimic.env_config("planar4dof", control_dt=0.9)
    with pytest.raises(ValueError, match="exceed its limits"):
        prepare_recording(RecordingConfig(config, count=1, out=str(tmp_path / "new.npz")))
