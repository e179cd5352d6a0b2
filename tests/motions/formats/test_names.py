"""Names of columns and joints as files of others have them."""

import pytest

from mimic.motions.formats.episodes import ANGLE, TORQUE, VELOCITY
from mimic.motions.formats.names import find_joints, hand_position, parse_column, select


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("joint1", ("joint1", ANGLE, "")),
        ("shoulder_pan.pos", ("shoulder_pan", ANGLE, "")),
        ("joint1.vel", ("joint1", VELOCITY, "")),
        ("q_3", ("3", ANGLE, "")),
        ("qdot3", ("3", VELOCITY, "")),
        ("dq_elbow", ("elbow", VELOCITY, "")),
        ("/joint_states/panda_joint1/position", ("/joint_states/panda_joint1", ANGLE, "")),
        ("elbow [deg]", ("elbow", ANGLE, "deg")),
        ("elbow_velocity (rad/s)", ("elbow", VELOCITY, "rad")),
        ("left_arm_joint_1_rad", ("left_arm_joint_1", ANGLE, "rad")),
        ("tau_2", ("2", TORQUE, "")),
        ("actual_qd_0", ("actual 0", VELOCITY, "")),
        ("wrist_angle", ("wrist_angle", ANGLE, "")),
        ("time [ms]", ("time", ANGLE, "ms")),
    ],
)
def test_columns(text, expected):
    assert parse_column(text) == expected


@pytest.mark.parametrize(
    ("present", "joints", "expected"),
    [
        (["x", "b", "a"], ["a", "b"], ["a", "b"]),
        (["motor_0", "motor_1", "gripper"], ["shoulder", "elbow"], ["motor_0", "motor_1"]),
        (["target 0", "target 1", "actual 0", "actual 1"], ["shoulder", "elbow"], ["actual 0", "actual 1"]),
        (["joint_0", "joint_1", "joint_2"], ["shoulder", "elbow"], None),
        (["joint_1", "joint_2", "gripper"], ["joint1", "joint2"], ["joint_1", "joint_2"]),
        (
            ["panda_joint1", "panda_joint2", "panda_finger_joint1"],
            ["joint1", "joint2"],
            ["panda_joint1", "panda_joint2"],
        ),
        (["main_shoulder_pan", "main_elbow"], ["shoulder_pan", "elbow"], ["main_shoulder_pan", "main_elbow"]),
        (["joint1", "joint2"], ["panda_joint1", "panda_joint2"], ["joint1", "joint2"]),
        (["Shoulder Pan", "elbow"], ["shoulder_pan_joint", "elbow_joint"], ["Shoulder Pan", "elbow"]),
        (["Joint 1 Angle", "Joint 2 Angle"], ["joint1", "joint2"], ["Joint 1 Angle", "Joint 2 Angle"]),
        (
            ["observation.state.0", "observation.state.1", "action.0", "action.1"],
            ["a", "b"],
            ["observation.state.0", "observation.state.1"],
        ),
        (["elbow_joint", "wrist_joint"], ["wrist", "elbow"], ["wrist_joint", "elbow_joint"]),
        (["1", "2", "3"], ["shoulder", "elbow"], ["1", "2"]),
        (["left_joint1", "left_joint2", "right_joint1", "right_joint2"], ["joint1", "joint2"], None),
        (
            ["target_joint1", "target_joint2", "joint1_x", "actual_joint1", "actual_joint2"],
            ["joint1", "joint2"],
            ["actual_joint1", "actual_joint2"],
        ),
        (["left_joint1", "right_joint2"], ["joint1", "joint2"], None),
        (["a", "A"], ["b"], None),
    ],
)
def test_joints_are_found_by_name_prefix_or_order(present, joints, expected):
    found = find_joints(present, joints)
    assert (found and found[0]) == expected


def test_what_was_measured_goes_before_what_was_commanded():
    names = ["joint1", "joint2", "gripper"]
    selection = select("set", {"action": names, "observation.state": names}, names[:2], "", "feature")
    assert selection.entry == "observation.state" and selection.gripper == ["gripper"]
    assert selection.notes == ["observation.state: what was measured; topic=action is what was commanded"]
    action = select("set", {"action": names, "observation.state": names}, names[:2], "action", "feature")
    assert (action.entry, action.commanded) == ("action", [])


def test_poses_of_the_hand_are_no_angles():
    numbered = ["1", "2", "3", "4", "5", "6"]
    entries = dict.fromkeys(["observation.joints", "observation.eef_pose", "action.cartesian_position"], numbered)
    found = select("set", entries, list("abcdef"), "", "feature")
    assert (found.entry, found.commanded) == ("observation.joints", [])


@pytest.mark.parametrize(
    ("entries", "expected"),
    [(["action", "observation.state", "observation.effort"], ["action"]), (["a/state", "a/command", "b/command"], [])],
)
def test_commands_beside_a_named_entry_are_found_where_there_is_one(entries, expected):
    measured = next(name for name in entries if name.endswith("state"))
    assert select("set", dict.fromkeys(entries, ["a", "b"]), ["a", "b"], measured, "entry").commanded == expected


@pytest.mark.parametrize(
    ("entries", "joints", "expected"),
    [
        ({"s": ["left_joint1", "left_gripper", "right_joint1", "right_gripper"]}, ["left_joint1"], ["left_gripper"]),
        ({"s": ["1", "2", "3"]}, ["a", "b"], ["3"]),
        ({"s": ["1", "2", "3", "4", "5"]}, ["a", "b"], []),
        ({"o.joints": ["a"], "o.gripper": ["1"], "action.gripper": ["1"]}, ["a"], ["1"]),
        ({"s": ["a", "camera_tilt"]}, ["a"], []),
    ],
)
def test_the_gripper_of_the_joints_is_found(entries, joints, expected):
    assert select("set", entries, joints, "", "entry").gripper == expected


@pytest.mark.parametrize(
    ("entry", "names", "expected"),
    [
        ("eef_pos", ["0", "1", "2"], ["0", "1", "2"]),
        ("ee_state", ["0", "1", "2", "3"], ["0", "1", "2"]),
        ("hand_state", ["0", "1", "2", "3"], None),  # joints of fingers, perhaps
        ("observation.hand", ["0", "1", "2"], None),
        ("hand_state", ["x", "y", "z"], ["x", "y", "z"]),
        ("s", ["hand_x", "hand_y", "hand_z", "a"], ["hand_x", "hand_y", "hand_z"]),
    ],
)
def test_positions_of_the_hand_are_found(entry, names, expected):
    assert hand_position({entry: names}) == (expected and (entry, expected))
