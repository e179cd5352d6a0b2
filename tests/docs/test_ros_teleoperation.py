"""The example of a ROS 2 node, with the messages of rosbags in place of those of ROS."""

import sys

import numpy as np
import pytest

import mimic
from mimic.arms.link_match import hand_poses
from tests.helpers import original_model
from tests.helpers.repository import REPOSITORY

typesys = pytest.importorskip("rosbags.typesys", reason="needs rosbags")
pytest.importorskip("ruckig", reason="needs ruckig")
sys.path.append(str(REPOSITORY / "examples"))

import ros_teleoperation  # noqa: E402  # pyright: ignore[reportMissingImports]

HOME = np.array([0, -0.8, 0, -2.4, 0, 1.6, 0.8])
START = np.array([0.3, -1.2, 1.4, -1.0, -1.2, 0.2])
RATE = 100.0


@pytest.fixture(scope="module")
def message():
    """A function that serialises a joint state and reads it again, as it arrives from ROS 2."""
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types = store.types

    def make(names, position, time):
        stamp = types["builtin_interfaces/msg/Time"](sec=int(time), nanosec=int(time % 1 * 1e9))
        header, empty = types["std_msgs/msg/Header"](stamp=stamp, frame_id=""), np.zeros(0)
        state = types["sensor_msgs/msg/JointState"](
            header=header, name=list(names), position=np.array(position), velocity=empty, effort=empty
        )
        return store.deserialize_cdr(store.serialize_cdr(state, state.__msgtype__), state.__msgtype__)

    return make


def test_joint_states_of_a_leader_become_commands_of_a_follower(message, tmp_path):
    """The follower waits for its pose; joints arrive in another order, with others, and some messages lack one."""
    file = original_model.ur_file(tmp_path)
    arm = ros_teleoperation.JointStateFollower("panda", str(file), RATE, hand="relative", velocity=3.0)
    panda, follower = (
        mimic.build_arm(mimic.ArmConfig(model=model), "hardware").embodiment for model in ("panda", str(file))
    )
    names = [*reversed(panda.joint_names), "finger"]
    arm.lead(message(names, [*HOME[::-1], 0.02], 0.0))
    assert arm.tick() is None
    arm.measured(message(follower.joint_names[:-1], START[:-1], 0.0))
    assert arm.tick() is None  # one joint is unknown
    arm.measured(message(follower.joint_names, START, 0.0))
    path = []
    for tick in range(300):
        qpos = HOME + 0.1 * np.sin(min(tick, 150) / RATE * np.arange(1, 8))
        lost = tick % 10 == 3
        arm.lead(message(names[lost:], [*qpos[::-1], 0.02][lost:], tick / RATE))
        commanded, angles = arm.tick()
        path.append(angles)
    assert tuple(commanded) == follower.joint_names
    assert np.abs(np.diff([START, *path], axis=0)).max() <= 3.0 / RATE + 1e-9
    moved = hand_poses(follower, path[-1])[0, :3, 3] - hand_poses(follower, START)[0, :3, 3]
    np.testing.assert_allclose(moved, hand_poses(panda, qpos)[0, :3, 3] - hand_poses(panda, HOME)[0, :3, 3], atol=2e-3)
