"""Objects of robosuite's simulations against C MuJoCo."""

from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from mimic.motions.formats.hdf5_objects import object_poses

MODEL = """<mujoco><compiler angle="radian" boundmass="1" boundinertia="1"/><worldbody>
<body name="table" pos="1 2 3"/>
<body name="base" pos="0.1 -0.2 0.9" quat="0.8 0 0 0.6"><body name="link" pos="0 0 0.3"><joint name="j1"/>
  <body name="finger"><joint name="jaw" type="slide" axis="0 1 0"/></body></body></body>
<body name="cube" pos="5 5 5"><freejoint name="cube"/></body>
<body name="cabinet" pos="0.5 0 0" quat="0.5 0.5 0.5 0.5">
  <body name="door" pos="0.3 0 0"><joint name="hinge" axis="1 2 2" pos="0.2 0.1 0"/>
    <body name="bolt" pos="0 0.1 0"><joint name="bolt" type="slide" axis="0 3 4"/></body></body></body>
</worldbody></mujoco>"""
COLUMNS = {"j1": 1, "jaw": 2, "cube": 3, "hinge": 10, "bolt": 11}
OBJECTS = "cube", "door", "bolt"


def test_poses_are_those_of_mujoco():
    model = mujoco.MjModel.from_xml_string(MODEL)
    data, states = mujoco.MjData(model), np.random.default_rng(0).normal(size=(5, 12))
    found = object_poses(ElementTree.fromstring(MODEL), COLUMNS, states, ["j1"])
    assert found is not None
    for row, poses in zip(states, found, strict=True):
        data.qpos[:] = row[1:]
        mujoco.mj_kinematics(model, data)
        base = pose_of(data, "base")
        for name, pose in zip(OBJECTS, poses, strict=True):
            np.testing.assert_allclose(base @ pose, pose_of(data, name), atol=1e-12)


def pose_of(data, name):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = data.body(name).xmat.reshape(3, 3), data.body(name).xpos
    return pose


@pytest.mark.parametrize(
    "changes", [('<body name="door"', '<body euler="0 0 1" name="door"'), ('name="hinge"', 'name="other"'),
                ('name="j1"', 'name="j2"'), ('<joint name="hinge"', '<joint type="ball" name="hinge"')]
)  # fmt: skip
def test_what_is_not_computed_has_no_objects(changes):
    model = ElementTree.fromstring(MODEL.replace(*changes))
    assert object_poses(model, COLUMNS, np.ones((2, 12)), ["j1"]) is None


@pytest.mark.parametrize(("columns", "value"), [(slice(6, 10), 0), (3, np.nan), (10, np.inf)])
def test_an_object_without_a_pose_is_none(columns, value):
    states = np.ones((2, 12))
    states[1, columns] = value
    assert object_poses(ElementTree.fromstring(MODEL), COLUMNS, states, ["j1"]) is None


def test_numbers_that_are_missing_are_named():
    with pytest.raises(ValueError, match="expected 3 numbers as pos, got '0.3 0'"):
        object_poses(ElementTree.fromstring(MODEL.replace("0.3 0 0", "0.3 0")), COLUMNS, np.ones((2, 12)), ["j1"])
