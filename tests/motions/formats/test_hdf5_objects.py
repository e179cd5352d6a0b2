"""Objects of robosuite's simulations against C MuJoCo."""

import mujoco
import numpy as np
import pytest

from mimic.motions.formats.hdf5_objects import object_poses, skeleton

MODEL = """<mujoco><compiler angle="radian" boundmass="1" boundinertia="1"/><worldbody>
<body name="table" pos="1 2 3"/>
<body name="base" pos="0.1 -0.2 0.9" quat="0.8 0 0 0.6"><body name="link" pos="0 0 0.3"><joint name="j1"/>
  <body name="finger"><joint name="jaw" type="slide" axis="0 1 0"/></body></body></body>
<body name="cube" pos="5 5 5"><freejoint name="cube"/></body>
<body name="cabinet" pos="0.5 0 0" quat="0.5 0.5 0.5 0.5">
  <body name="door" pos="0.3 0 0"><joint name="hinge" axis="1 2 2" pos="0.2 0.1 0"/>
    <body name="bolt" pos="0 0.1 0"><joint name="bolt" type="slide" axis="0 3 4"/></body></body></body>
</worldbody></mujoco>"""
ARM = [0, 1]
OBJECTS = "cube", "door", "bolt"


def test_poses_are_those_of_mujoco():
    model = mujoco.MjModel.from_xml_string(MODEL)
    data, states = mujoco.MjData(model), np.random.default_rng(0).normal(size=(5, 12))
    with_shape = MODEL.replace('<joint name="j1"/>', '<geom mesh="missing"/><joint name="j1"/>')
    found = object_poses(skeleton(with_shape), states, ARM)
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


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_states_that_are_not_finite_have_no_objects(value):
    states = np.ones((2, 12))
    states[1, 3] = value
    assert object_poses(skeleton(MODEL), states, ARM) is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("0.3 0 0", "0.3 0"), "Error"),
        (("<worldbody>", "<worldbody>" + "<site/>" * 10_001), "more than 10,000 elements"),
    ],
)
def test_a_model_that_cannot_be(changes, message):
    with pytest.raises(ValueError, match=message):
        skeleton(MODEL.replace(*changes))
