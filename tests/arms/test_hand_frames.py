"""Hand frames: each rule on tiny models, the same frame from every file of an arm, and as C MuJoCo moves it."""

import mujoco
import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, arm_spec
from mimic.arms.embodiment import load_mjcf, panda_path
from mimic.arms.link_match import hand_poses
from mimic.arms.mujoco_chain import base_pose, chain_ends
from mimic.arms.names import finger_side
from mimic.arms.visual_model import HAND_LINE, visual_spec
from tests.helpers.original_model import package_file

TO_X = 'euler="0 1.5707963267948966 0"'  # z along the world's x
X, Y, Z = np.eye(3)


def frame(name, pos, turn=""):
    return f'<site name="{name}" pos="{pos}" {turn}/>'


def finger(name, pos, axis, kind="slide", reach="0 0.04", inner=""):
    joint = f'<joint name="{name}_joint" type="{kind}" axis="{axis}" range="{reach}"/><geom size="0.01"/>'
    return f'<body name="{name}" pos="{pos}">{joint}{inner}</body>'


def arm(end, axes=("0 0 1", "0 1 0", "1 0 0"), asset=""):
    """Joints 1 m apart along x; the last one rolls about x, or pitches with another axis; `end` is on the last link."""
    for number, axis in reversed(list(enumerate(axes))):
        pos = "1 0 0" if number else "0 0 0"
        end = (
            f'<body name="l{number}" pos="{pos}"><joint name="j{number}" axis="{axis}"/><geom size="0.05"/>{end}</body>'
        )
    return f'<mujoco><compiler angle="radian" autolimits="true"/>{asset}<worldbody>{end}</worldbody></mujoco>'


def end_of(xml, **options):
    (end,) = chain_ends(mujoco.MjModel.from_xml_string(xml), **options)
    assert np.allclose(end.rotation @ end.rotation.T, np.eye(3)) and np.linalg.det(end.rotation) > 0
    return end


PITCH = ("0 0 1", "0 1 0", "0 1 0")
SLIDES = finger("right", "0.1 0 0", "0 0 -1") + finger("left", "0.1 0 0", "0 0 1")  # both closed, at one point
HINGES = finger("right_f", "0.1 0 -0.03", "0 1 0", "hinge", "0 0.8") + finger(
    "left_f", "0.1 0 0.03", "0 1 0", "hinge", "-0.8 0"
)
JAW = finger("moving_jaw", "0.05 0 0.02", "0 1 0", "hinge", "-1.7 0.2")
CASES = {  # what is on the last link, the joints' axes, and the approach and the opening that follow
    "z forward": (frame("tcp", "0.1 0 0", TO_X), X, Y),
    "x forward": (frame("ee_gripper_link", "0.1 0 0"), X, Y),
    "-z forward": (frame("tool0", "0.1 0 0", 'euler="0 -1.5707963267948966 0"'), X, Y),
    "y forward": (frame("tcp", "0.1 0 0", 'euler="0 0 -1.5707963267948966"'), X, Z),
    "tilted": (frame("tcp", "0.1 0 0", 'euler="0 1.2707963267948966 0"'), (np.cos(0.3), 0, np.sin(0.3)), Y),
    "askew": (frame("tcp", "0.1 0 0", 'euler="0 0.7853981633974483 0"'), X, Y),
    "z forward of two at one point": (frame("ee_link", "0.1 0 0") + frame("tool0", "0.1 0 0", TO_X), X, Y),
    "at the last joint": (frame("tool0", "0 0 0", TO_X), X, Y),
    "slides": (SLIDES, X, Z),
    "slides and a frame that opens otherwise": (SLIDES + frame("tcp", "0.15 0 0", TO_X), X, Z),
    "slides with a mount": (SLIDES + frame("tool0", "0.02 0 0", TO_X), X, Z),
    "open hinges": (HINGES, X, Z),
    "jaw": (JAW + frame("gripper_frame", "0.1 0 -0.01", TO_X), X, Z),
    "no frame": ("", X, -Z),
    "a sphere that marks the tool": ('<geom name="end_effector" size="0.001" pos="0.1 0 0"/>', X, Y),
    "a frame that no name tells": (frame("plate", "0.1 0.02 0", 'euler="0.4 0.5 0.6"'), X, -Z),
}


@pytest.mark.parametrize("case", CASES)
def test_the_approach_and_the_opening(case):
    content, approach, opening = CASES[case]
    end = end_of(arm(content))
    np.testing.assert_allclose(end.rotation[:, [2, 0]].T, [approach, opening], atol=1e-12)


@pytest.mark.parametrize(
    ("content", "opening"),
    [
        (finger("left", "0.1 0.01 0", "0 1 0") + finger("right", "0.1 -0.01 0", "0 -1 0"), Y),
        (frame("end_effector_link", "0.1 0 0"), Y),
        ("", Z),  # the last joint's axis across the link, as of planar arms
    ],
)
def test_a_wrist_that_pitches_approaches_along_its_link(content, opening):
    rotation = end_of(arm(content + "<geom type='capsule' fromto='0 0 0 0.1 0 0' size='0.01'/>", PITCH)).rotation
    np.testing.assert_allclose(np.abs(rotation[:, [2, 0]].T), [X, opening], atol=1e-12)
    assert rotation[0, 2] > 0


@pytest.mark.parametrize(
    ("content", "doubt"),
    [
        (frame("tcp", "0.1 0 0", 'euler="0 0.7853981633974483 0"'), "site 'tcp' has no axis within 45 deg of"),
        (
            frame("a_tcp", "0.1 0 0", TO_X) + frame("b_tcp", "0.2 0 0", TO_X),
            "site 'a_tcp', whose name tells as much, is",
        ),
        (frame("tool0", "0.1 0 0", TO_X) + frame("flange", "0.1 0 0"), None),
        (
            frame("tcp", "0.1 0 0", f"{TO_X}") + frame("ee", "0.1 0 0", 'euler="0.785 0 0"'),
            "the opening by site 'ee' is",
        ),
        (JAW + frame("gripper_stator", "0.01 0 0"), "body 'moving_jaw' is distal of it"),
        (JAW + frame("tool0", "0.01 0 0", TO_X), "body 'moving_jaw' is distal of it"),
        (JAW, "no frame marks the tip of the finger"),
        (frame("ee_link", "0.1 0 0"), "nothing tells how a gripper would open"),
        (SLIDES, "no frame marks the tips of the fingers"),
        ("", "no name tells where the tool is; nothing tells how a gripper would open"),
    ],
)
def test_doubts(content, doubt):
    said = end_of(arm(content)).doubt
    assert said.startswith(doubt) if doubt else not said


def test_the_origin_is_between_the_tips_and_not_at_the_mount():
    tips = '<body name="{0}_tip" pos="0.04 0 0"/>'
    fingers = [finger(side, "0.1 0 0", f"0 0 {sign}", inner=tips.format(side)) for side, sign in (("l", 1), ("r", -1))]
    end = end_of(arm("".join(fingers) + frame("tcp", "0.01 0 0", TO_X)))
    np.testing.assert_allclose(end.point, [2.14, 0, 0])
    assert not end.doubt
    np.testing.assert_allclose(end_of(arm(SLIDES + frame("tcp", "0.12 0 0", TO_X))).point, [2.12, 0, 0])


def test_the_side_of_a_finger_is_named_last():
    names = "r_gripper_l_finger_tip_link", "openarm_left_finger", "left_hand_right_finger", "link7"
    assert [finger_side(name) for name in names] == ["left", "left", "right", ""]


def test_a_mesh_changes_no_axis():
    asset = '<asset><mesh name="m" vertex="0 0 0 0.5 0 0 0 0.1 0 0 0 0.9"/></asset>'
    for content, *_ in CASES.values():
        plain, drawn = (end_of(arm(content + mesh, asset=asset)) for mesh in ("", '<geom type="mesh" mesh="m"/>'))
        np.testing.assert_array_equal(plain.rotation, drawn.rotation)
        np.testing.assert_array_equal(plain.point, drawn.point)


def test_a_urdf_has_the_hand_of_its_mjcf(tmp_path):
    links = "".join(
        f'<link name="{name}"/>' for name in ("base", "l0", "l1", "l2", "right", "left", "gripper_tool_frame")
    )
    joints = [("j0", "base", "l0", "0 0 0", "0 0 1"), ("j1", "l0", "l1", "1 0 0", "0 1 0"),
              ("j2", "l1", "l2", "1 0 0", "1 0 0"), ("right_joint", "l2", "right", "0.1 0 0", "0 0 -1"),
              ("left_joint", "l2", "left", "0.1 0 0", "0 0 1")]  # fmt: skip
    text = "".join(
        f'<joint name="{name}" type="{"prismatic" if "_" in name else "revolute"}"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="{origin}"/><axis xyz="{axis}"/>'
        '<limit lower="0" upper="0.04" effort="1" velocity="1"/></joint>'
        for name, parent, child, origin, axis in joints
    )
    tool = (
        '<joint name="t" type="fixed"><parent link="l2"/><child link="gripper_tool_frame"/>'
        '<origin xyz="0.13 0 0"/></joint>'
    )
    file = tmp_path / "arm.urdf"
    file.write_text(f'<robot name="arm">{links}{text}{tool}</robot>')
    urdf, mjcf = load_mjcf(file), load_mjcf(mujoco.MjModel.from_xml_string(arm(SLIDES + frame("x_tool", "0.13 0 0"))))
    np.testing.assert_allclose(urdf.hand_position, mjcf.hand_position, atol=1e-12)
    np.testing.assert_allclose(urdf.hand_rotation, mjcf.hand_rotation, atol=1e-12)
    drawn = visual_spec(ArmConfig(model=str(file)))[0].compile()
    assert mujoco.mj_name2id(drawn, mujoco.mjtObj.mjOBJ_GEOM, f"{HAND_LINE}0 x") >= 0


# --- the user's choice ------------------------------------------------------------------------------------------------


def test_a_hand_that_the_user_gives_is_taken_as_it_is():
    content = arm(frame("odd", "0.1 0 0", 'euler="0.1 0.2 0.3"') + frame("tcp", "0.2 0 0", TO_X))
    model = mujoco.MjModel.from_xml_string(content)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    named = end_of(content, hand="odd")
    np.testing.assert_allclose(named.rotation.ravel(), data.site("odd").xmat)
    np.testing.assert_allclose(end_of(content, hand="l2").rotation, np.eye(3), atol=1e-12)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, data.site("odd").xmat)
    given = end_of(content, hand=[0.1, 0, 0, *(2 * quaternion)])
    np.testing.assert_allclose(given.rotation, named.rotation, atol=1e-12)
    np.testing.assert_allclose(given.point, [2.1, 0, 0])
    config = ArmConfig(model=panda_path(), hand=[0, 0, 0.2, 1, 0, 0, 0])
    np.testing.assert_allclose(mimic.build_arm(config).embodiment.hand_position, [[0.088, 0, 0.833]], atol=1e-12)


@pytest.mark.parametrize(
    ("hand", "message"),
    [
        ("l1", "hand: expected a site or body that is fixed to the last link, 'l2', 'tcp', got 'l1'"),
        ([0, 0, 0, 1], r"hand: expected a name or a pose \[x, y, z, qw, qx, qy, qz\] in the last link, got"),
        ([0, 0, 0, 0, 0, 0, 0], "hand: expected a name or a pose"),
        ([0, 0, float("nan"), 1, 0, 0, 0], "hand: expected a name or a pose"),
        (["tcp", "tcp"], "hand: expected 1 names or poses, one for each chain, got 2"),
    ],
)
def test_hands_that_are_none(hand, message):
    with pytest.raises(ValueError, match=message):
        end_of(arm(frame("tcp", "0.2 0 0")), hand=hand)


# --- packaged and real arms -------------------------------------------------------------------------------------------


def test_the_panda_opens_as_frankas_hand_on_its_flange():
    """Franka mounts its hand at -45 deg about the flange's z-axis, and the fingers slide along the hand's y-axis."""
    rotation = mimic.panda().hand_rotation[0]
    flange = np.diag([1.0, -1.0, -1.0])  # at 0, by the DH table
    np.testing.assert_allclose(flange.T @ rotation[:, 2], Z, atol=1e-12)
    np.testing.assert_allclose(flange.T @ rotation[:, 0], [np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-12)


def test_the_panda_of_another_package_has_the_packaged_ones_axes():
    file = package_file("robosuite/models/assets/bullet_data/panda_description/urdf/panda_arm_hand.urdf")
    np.testing.assert_allclose(load_mjcf(file).hand_rotation, mimic.panda().hand_rotation, atol=1e-6)


def test_a_planar_arm_has_one_hand_however_it_is_read():
    arm = mimic.planar_arm([0.4, 0.3, 0.2])
    np.testing.assert_array_equal(arm.hand_rotation[0], np.stack([Y, Z, X], axis=1))
    read = mimic.build_arm(ArmConfig(model="planar", link_lengths=[0.4, 0.3, 0.2])).embodiment
    np.testing.assert_allclose(read.hand_rotation, arm.hand_rotation, atol=1e-12)
    np.testing.assert_allclose(read.hand_position, arm.hand_position, atol=1e-12)


PACKAGED = {
    "panda": {}, "panda_pair": {}, "planar": {"link_lengths": [0.4, 0.3, 0.2]}, "locked": {"locked": {3: 0.5, 7: -1.0}},
}  # fmt: skip


@pytest.mark.parametrize("name", PACKAGED)
def test_hands_move_as_in_mujoco_and_with_every_joint(name):
    config = ArmConfig(model="panda" if name == "locked" else name, **PACKAGED[name])
    arm, locked = mimic.build_arm(config), PACKAGED[name].get("locked", {})
    model = arm_spec(config).compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    T_base_world = np.linalg.inv(base_pose(model, config.base, config.tip))
    bodies = [
        int(model.jnt_bodyid[model.joint(arm.embodiment.joint_names[joint]).id]) for joint in arm.embodiment.hand_joint
    ]
    if name == "locked":
        bodies = [model.body("body7").id]

    def of_bodies(angles):
        for joint, angle in angles.items():
            data.joint(joint).qpos[0] = angle
        mujoco.mj_kinematics(model, data)
        poses = np.tile(np.eye(4), (len(bodies), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = data.xmat[bodies].reshape(-1, 3, 3), data.xpos[bodies]
        return T_base_world @ poses

    names = arm.embodiment.joint_names
    free = mimic.build_arm(ArmConfig(model=config.model, link_lengths=config.link_lengths)).embodiment
    T_body_hand = np.linalg.inv(of_bodies({})) @ hand_poses(free, np.zeros(free.num_joints))
    for _ in range(3):
        qpos = rng.uniform(-2, 2, len(names))
        angles = dict(zip(names, qpos, strict=True)) | {f"joint{joint}": angle for joint, angle in locked.items()}
        hands = hand_poses(arm.embodiment, qpos)
        np.testing.assert_allclose(hands, of_bodies(angles) @ T_body_hand, atol=1e-9)
        frames = mimic.hand_frames(arm.embodiment, qpos)
        np.testing.assert_allclose(frames.position, hands[:, :3, 3], atol=1e-6)  # float32
        np.testing.assert_allclose(frames.rotation, hands[:, :3, :3], atol=2e-6)
        for joint in range(len(names)):  # of the pair each arm moves its own hand
            moved = np.abs(hand_poses(arm.embodiment, qpos + 0.1 * np.eye(len(names))[joint]) - hands)
            assert (moved.max(axis=(1, 2)) > 0.01).sum() == 1


@pytest.mark.parametrize("name", ["panda_pair", "planar"])
def test_a_picture_has_the_hands_where_they_are(name):
    config = ArmConfig(model=name, **PACKAGED[name])
    arm = mimic.build_arm(config).embodiment
    spec, T_world_base = visual_spec(config)
    model = spec.compile()
    data, qpos = mujoco.MjData(model), np.random.default_rng(0).uniform(-2, 2, arm.num_joints)
    for joint, angle in zip(arm.joint_names, qpos, strict=True):
        data.joint(joint).qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    for number, pose in enumerate(T_world_base @ hand_poses(arm, qpos)):
        for axis, letter in enumerate("xyz"):
            line = data.geom(f"{HAND_LINE}{number} {letter}")  # from the hand along its axis
            half = model.geom(line.id).size[1]
            np.testing.assert_allclose(line.xpos, pose[:3, 3] + half * pose[:3, axis], atol=1e-9)
            np.testing.assert_allclose(np.abs(line.xmat.reshape(3, 3)[:, 2] @ pose[:3, axis]), 1, atol=1e-9)
