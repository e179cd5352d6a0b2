"""Units of recorded angles: stated, found where only one fits, or a question."""

import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.motions.formats.episodes import Motion, Recording
from mimic.motions.importing import read_recording
from mimic.motions.units import find_unit, in_rad
from tests.helpers.real_data import DATA, TELEOP, needs

NAMES, RANGE = ("a", "b"), np.array([[-2.0, 2.0], [0.0, 3.0]])  # rad
SWING = np.sin(0.1 * np.arange(100))[:, None]


def recording(low, high, robot="", unit=""):
    """Two joints that swing from the lowest to the highest values."""
    low, high = np.array(low, float), np.array(high, float)
    return Recording(
        {"episode 0": Motion(np.arange(100) / 30, (low + high) / 2 + (high - low) / 2 * SWING, None)}, (), unit, robot
    )


@pytest.mark.parametrize(
    ("low", "high", "robot", "expected"),
    [
        ([-1, 0.5], [1, 2.5], "", "rad"),
        ([-1, 0.5], [1, 2.5], None, "rad"),
        ([-110, 5], [110, 170], "", "deg"),  # beyond 100 percent
        ([-110, 5], [110, 170], None, "rad"),  # no LeRobot: rejected later, as no angles
        ([-90, -90], [90, 90], "", "percent"),  # b does not go below 0
        ([-0.5, 0.5], [0.5, 1.0], "so101_follower", "rad"),  # nobody records half a degree
    ],
)
def test_the_only_unit_that_fits_is_found(low, high, robot, expected):
    unit, line = find_unit("set", recording(low, high, robot), NAMES, RANGE, "")
    assert unit == expected
    assert f"units: {expected}, {'as is usual' if robot is None else 'found from'}" in line


@pytest.mark.parametrize(
    ("low", "high", "robot", "message"),
    [
        ([-60, 20], [60, 90], "koch_follower", "its robot_type is 'koch_follower': a from -60.* fits degrees, percent"),
        ([-60, 20], [60, 90], "", "fits degrees, percent; expected one of units=deg, units=percent"),
        ([-1.7, 0.5], [1.7, 1.7], "so100", "fits rad, degrees, percent"),
        ([-300, 0], [300, 0], "", "fits none of rad, degrees and percent"),
    ],
)
def test_several_units_are_a_question(low, high, robot, message):
    with pytest.raises(ValueError, match=message):
        find_unit("set", recording(low, high, robot), NAMES, RANGE, "")
    assert find_unit("set", recording(low, high, robot), NAMES, RANGE, "deg") == ("deg", "")
    assert find_unit("set", recording(low, high, robot, "percent"), NAMES, RANGE, "") == ("percent", "")


def test_whole_steps_of_a_servo_are_degrees():
    source = recording([-60, 20], [60, 90], "so101")
    motion = source.motions["episode 0"]
    steps = motion._replace(qpos=np.round(motion.qpos / (360 / 4095)) * (360 / 4095))
    assert find_unit("set", source._replace(motions={"episode 0": steps}), NAMES, RANGE, "")[0] == "deg"


def test_conversions():
    source = recording([-100, -100], [100, 100])
    motion = source.motions["episode 0"]._replace(qvel=np.ones((100, 2)))
    (percent,) = in_rad(Recording({"": motion}), "percent", RANGE).motions.values()
    np.testing.assert_allclose(percent.qpos, [0, 1.5] + SWING * [2, 1.5], atol=1e-12)
    assert percent.qvel is not None
    np.testing.assert_allclose(percent.qvel, np.tile([0.02, 0.015], (100, 1)))
    (degrees,) = in_rad(Recording({"": motion}), "deg", RANGE).motions.values()
    np.testing.assert_allclose(degrees.qpos, np.radians(motion.qpos))
    with pytest.raises(ValueError, match="units=percent: expected an arm whose joints all have limits"):
        in_rad(source, "percent", np.array([[-np.pi, np.pi], [0, 1]]))
    with pytest.raises(ValueError, match="units: expected one of rad, deg, percent, got 'degree'"):
        find_unit("set", source, NAMES, RANGE, "degree")


@needs(TELEOP)
def test_a_real_leader_records_degrees_and_its_follower_percent():
    """The leader's are whole servo steps; the follower's, as percent of its ranges, whole thousandths of a degree."""
    joints = ["joint1", "joint2", "joint3", "joint5", "joint6"]  # joint 4 never moves
    piper = build_arm(ArmConfig(model=str(DATA / "arms/piper.urdf")), "hardware").embodiment
    follower = read_recording(TELEOP, piper)
    assert len(follower.motions) == 55 and follower.gripper == ("gripper",)
    assert any(line.startswith("units: percent, found from") for line in follower.notes)
    angles = np.concatenate([motion.qpos for motion in follower.motions.values()])
    columns = [piper.joint_names.index(joint) for joint in joints]
    full = np.radians([300, 180, 170, 140, 360])  # the ranges that the software of the recording has
    corrected = (angles[:, columns] - piper.joint_range[columns].mean(axis=1)) / np.ptp(
        piper.joint_range[columns], axis=1
    )
    thousandths = np.degrees(corrected * full) * 1000
    assert np.abs(thousandths - np.round(thousandths)).max() < 0.01
    opening = np.concatenate([motion.gripper for motion in follower.motions.values() if motion.gripper is not None])
    assert 0 <= opening.min() < 2 and 95 < opening.max() <= 100
    assert all(np.allclose(np.diff(motion.time), 1 / 15) for motion in follower.motions.values())
