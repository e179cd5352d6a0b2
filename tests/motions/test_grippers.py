"""Openings of one gripper as those of another, and the ends at which a gripper is open."""

import dataclasses

import numpy as np
import pytest

from mimic.arms.arm import ArmConfig
from mimic.arms.gripper import GripperRange, gripper_range
from mimic.motions.formats.episodes import Motion
from mimic.motions.grippers import other_gripper
from mimic.motions.importing import read_source
from mimic.motions.rewriting import read_data_set, write_data_set
from tests.motions.test_rewriting import EXPERT, LEARNER, NEW, RANGES, RATE, expert_motion

SLIDES = GripperRange(("f1", "f2"), np.array([0.0, 0.0]), np.array([0.04, -0.04]))  # as a Panda's in robosuite
JAW = GripperRange(("jaw",), np.array([-0.2]), np.array([1.8]))
DRIVER = GripperRange(("driver",), np.array([0.8]), np.array([0.0]))  # closes at 0.8
FRACTION = np.linspace(0, 1, 11)[:, None]


def finger(name, y, joint):
    tip = f'<body name="{name}_tip" pos="0 0 .05"/>'
    return f'<body name="{name}" pos="0 {y} .1">{joint}<geom size=".01" mass=".1"/>{tip}</body>'


def arm(tmp_path, fingers):
    """An arm of two joints with fingers."""
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><compiler angle="radian"/><worldbody><body name="a"><joint name="j1" axis="0 0 1" range="-3 3"/>'
        '<geom size=".02" mass="1"/><body name="b" pos="0 0 .3"><joint name="j2" axis="0 1 0" range="-2 2"/>'
        f'<geom size=".02" mass="1"/>{fingers}</body></body></worldbody></mujoco>'
    )
    return gripper_range(ArmConfig(model=str(path)))


def test_slides_are_open_where_fingers_are_apart(tmp_path):
    fingers = finger("left_finger", 0, '<joint name="f1" type="slide" axis="0 1 0" range="0 .04"/>')
    fingers += finger("right_finger", 0, '<joint name="f2" type="slide" axis="0 1 0" range="-.04 0"/>')
    found = arm(tmp_path, fingers)
    assert found is not None and found.names == ("f1", "f2") and found.travel == pytest.approx(0.08)
    np.testing.assert_allclose([found.closed, found.opened], [SLIDES.closed, SLIDES.opened])


def test_hinges_may_close_at_the_end_far_from_zero(tmp_path):
    fingers = finger("left_finger", 0.04, '<joint name="f1" axis="1 0 0" range="0 .8"/>')
    fingers += finger("right_finger", -0.04, '<joint name="f2" axis="-1 0 0" range="0 .8"/>')
    found = arm(tmp_path, fingers)
    assert found is not None
    np.testing.assert_allclose([found.closed, found.opened], [[0.8, 0.8], [0, 0]])
    assert arm(tmp_path, "") is None


@pytest.mark.parametrize(
    ("values", "expert", "learner", "expected"),
    [
        (FRACTION * [0.04, -0.04], SLIDES, JAW, -0.2 + 2 * FRACTION * [1, 1]),
        (FRACTION * 0.08, SLIDES, DRIVER, 0.8 * FRACTION),  # a width, and how far the other opens
        (-0.2 + 2 * FRACTION, JAW, DRIVER, 0.8 - 0.8 * FRACTION),
        (-0.2 + 2 * FRACTION, JAW, SLIDES, 0.04 * FRACTION),
        (FRACTION * 0.04, SLIDES, DRIVER, None),  # half of a width, or a finger
        (100 * FRACTION, JAW, DRIVER, None),  # percent
        (2 * FRACTION - 1, SLIDES, DRIVER, None),  # robosuite's command
        (FRACTION * [0.04, -0.04], SLIDES, SLIDES, None),
        (FRACTION * [0.04, -0.04], None, JAW, None),
    ],
)
def test_the_fraction_of_the_range_stays(values, expert, learner, expected):
    found = other_gripper(values, expert, learner)
    assert (found is None) == (expected is None)
    if found is not None:
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_one_named_joint_of_several_is_no_width():
    """A driver of 0.8 rad when closed is no opening; without a name it may be one or the other."""
    driver = GripperRange(("left_driver", "right_driver"), np.array([0.8, 0.8]), np.zeros(2))
    for expert, closed, opened in ((driver, 0.8, 0.0), (SLIDES, SLIDES.closed[0], SLIDES.opened[0])):
        values = closed + FRACTION * (opened - closed)
        found = other_gripper(values, expert, JAW, f"robot0_{expert.names[0]}")
        assert found is not None
        np.testing.assert_allclose(found, -0.2 + 2 * FRACTION, atol=1e-12)
    assert other_gripper(0.8 - 0.8 * FRACTION, driver, JAW) is None


@pytest.mark.parametrize("kind", ["csv", "hdf5"])
def test_it_is_written_in_the_columns_of_the_source(tmp_path, kind):
    (tmp_path / "in").mkdir()
    time, qpos = expert_motion(40)
    opening = 0.02 + 0.02 * np.sin(time)[:, None]
    if kind == "csv":
        source, header = tmp_path / "in/m.csv", ",".join(["time", *EXPERT.joint_names, "gripper"])
        np.savetxt(source, np.c_[time, qpos, opening], delimiter=",", header=header, comments="")
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(source := tmp_path / "in/m.hdf5", "w") as file:
            file.attrs["fps"] = RATE
            file["demo_0/obs/robot0_joint_pos"], file["demo_0/obs/robot0_gripper_qpos"] = qpos, opening
    data = read_data_set(source, EXPERT)
    (name,) = data.measured
    new = np.c_[qpos, qpos[:, 0]]
    motion = Motion(time, new, new, 10 * opening)
    write_data_set(data, tmp_path, dataclasses.replace(LEARNER), {data.entry: {name: motion}}, [name], RANGES)
    (back,) = read_source(tmp_path / source.name, NEW, "", None).motions.values()
    np.testing.assert_allclose(np.asarray(back.gripper), 10 * opening, atol=1e-8)
