"""Where an arm ends, and which joints are its gripper's: tiny models, and the same end with and without meshes."""

import mujoco
import pytest

from mimic.arms.embodiment import load_mjcf
from mimic.arms.mujoco_chain import chain_ends
from mimic.arms.names import is_gripper_joint, side, tool_rank


def body(name, pos, inner="", joint="", kind="hinge"):
    joint = f'<joint name="{joint}" type="{kind}" axis="0 0 1" range="-1 1"/><geom size="0.01"/>' if joint else ""
    return f'<body name="{name}" pos="{pos}">{joint}{inner}</body>'


def chain(prefix, count, end=""):
    for number in range(count, 0, -1):
        end = body(f"{prefix}_l{number}", "0.3 0 0", end, f"{prefix}_j{number}")
    return end


def arm(end, joints=3):
    """Joints j1, j2, … 1 m apart along x, and what is fixed to the last one."""
    for number in range(joints, 0, -1):
        end = body(f"l{number}", "1 0 0" if number > 1 else "0 0 0", end, f"j{number}")
    return model(end)


def model(worldbody, rest=""):
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian" autolimits="true"/><worldbody>{worldbody}</worldbody>{rest}</mujoco>'
    )


FINGERS = body("left", "0.1 0.05 0", joint="a", kind="slide") + body("right", "0.1 -0.05 0", joint="b", kind="slide")
JAW = body("moving_jaw", "0.1 0 0", joint="jaw")
CAMERA = body("camera_frame", "0 0 0.9")
ENDS = {  # what is fixed to the last link: its length, and the end in words
    "tool at the last joint": (body("tool0", "0 0 0") + CAMERA, 0, "body 'tool0', named as tools are"),
    "tool and not the camera": (body("tcp", "0.2 0 0") + CAMERA, 0.2, "body 'tcp', named as tools are"),
    "the more telling name": (body("tool0", "0.3 0 0") + body("tcp", "0.2 0 0"), 0.2, "body 'tcp', named"),
    "site": ('<site name="grip_site" pos="0.1 0 0"/>' + body("x", "0.2 0 0"), 0.1, "site 'grip_site', named"),
    "tool of tools": (body("flange", "0.1 0 0", body("x_tool_frame", "0.1 0 0")), 0.2, "body 'x_tool_frame', named"),
    "between the fingers": (FINGERS + body("palm", "0.05 0 0"), 0.1, "between body 'left', body 'right'"),
    "a tool of a gripper": (FINGERS + body("ee_link", "0.15 0 0"), 0.15, "body 'ee_link', named as tools are"),
    "a jaw and a hand": (JAW + body("gripper_link", "0.2 0 0"), 0.2, "body 'gripper_link', named as hands"),
    "a jaw": (JAW, 0.1, "body 'moving_jaw', a finger"),
    "hand": (body("gripper_link", "0.1 0 0") + body("plate", "0 0 0.5"), 0.1, "body 'gripper_link', named as hands"),
    "frame": (body("plate", "0 0.2 0") + CAMERA, 0.2, "body 'plate', the farthest frame"),
    "shape": ('<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.01"/>', 0.3, "the farthest end of the shapes"),
    "nothing": ("", 0, "joint 'j3', as no frame"),
    "camera alone": (CAMERA, 0, "joint 'j3', as no frame"),
}


@pytest.mark.parametrize("case", ENDS)
def test_the_last_link_ends_at_the_tool(case):
    content, length, reason = ENDS[case]
    lengths = load_mjcf(arm(content)).link_lengths.tolist()
    assert lengths == pytest.approx([1, 1, length] if length else [1, 1])
    assert chain_ends(arm(content))[0].reason.startswith(reason)


ARM = ("j1", "j2", "j3")
GRIPPERS = {
    "a jaw by its joint": (body("x", "0.1 0 0", joint="gripper"), ARM),
    "a jaw by its link": (body("Moving_Jaw", "0.1 0 0", joint="j4"), ARM),
    "a shaft beside the tool": (body("prop", "0 0 0", joint="shaft") + body("ee_gripper", "0.1 0 0"), ARM),
    "a joint distal of the tool": (body("tool0", "0.1 0 0", body("x", "0 0 0", joint="j4")), ARM),
    "a hand": (body("palm", "0 0 0", chain("thumb", 2) + chain("middle", 1)), ARM),
    "a mover": (body("gripperMover", "0.1 0 0", joint="jointGripper"), ARM),
    "a wrist": (body("gripper_link", "0.1 0 0", joint="wrist_roll"), (*ARM, "wrist_roll")),
    "a wrist of a gripper": (body("x", "0.1 0 0", joint="gripper_roll"), (*ARM, "gripper_roll")),
    "a wrist with a fixed jaw": (body("Fixed_Jaw", "0.1 0 0", joint="j4"), (*ARM, "j4")),
    "a joint before the tool": (body("x", "0.1 0 0", body("tool0", "0 0 0"), joint="j4"), (*ARM, "j4")),
}


@pytest.mark.parametrize("case", GRIPPERS)
def test_joints_of_the_gripper_are_not_the_arms(case):
    content, names = GRIPPERS[case]
    assert load_mjcf(arm(content)).joint_names == names


def test_heads_and_legs_are_no_arm_beside_one():
    head, leg = chain("head", 4), chain("left_leg", 6)
    assert load_mjcf(model(head + leg + chain("x", 2))).joint_names == ("x_j1", "x_j2")
    assert load_mjcf(model(head)).num_joints == 4  # where there is nothing else


def test_fingers_alone_are_a_chain():
    assert load_mjcf(model(chain("finger", 3))).num_joints == 3


def test_two_arms_get_a_line_with_tips_that_work():
    tools = [f'<site name="{name}_tcp" pos="0.1 0 0"/>' for name in ("left", "right")]
    torso = model(body("torso", "0 0 0", chain("left", 3, tools[0]) + chain("right", 3, tools[1]), "waist"))
    with pytest.raises(ValueError, match="2 chains of 4 revolute joints end at 'left_tcp', 'right_tcp'; name one"):
        load_mjcf(torso)
    assert load_mjcf(torso, tip="left_tcp").num_joints == 4
    assert load_mjcf(torso, tip=["left_tcp", "right_tcp"]).num_joints == 7


def test_an_arm_on_a_lift_starts_above_it():
    lift = body("platform", "0 0 0", body("mast", "0 0 0", chain("x", 3), "lift", "slide"), "turn")
    assert load_mjcf(model(lift)).joint_names == ("x_j1", "x_j2", "x_j3")


# --- equality constraints ---------------------------------------------------------------------------------------------

FOLLOWER = body("rod", "0 0.1 0", joint="cylinder")
BOX = '<body name="box" pos="3 0 0"><freejoint/><geom size="0.1"/></body>'


@pytest.mark.parametrize(
    ("constraint", "message"),
    [
        ('<joint joint1="cylinder" joint2="j2"/>', None),  # of a URDF's <mimic>: the cylinder follows
        ('<joint joint1="j2" joint2="cylinder"/>', None),
        ('<weld body1="l3" body2="box"/>', None),
        ('<weld body1="l3" body2="box"/><connect body1="box" body2="l3" anchor="0 0 0"/>', None),
        ('<weld body1="box" body2="world"/>', None),
        (
            '<joint joint1="j2" joint2="j3"/>',
            "'j2' and 'j3' of the arm are coupled by an equality constraint or <mimic>",
        ),
        ('<joint joint1="j2"/>', "'j2' of the arm is held by an equality constraint"),
        ('<weld body1="l3" body2="box"/><weld name="b" body1="box" body2="world"/>', "a loop, .* constraint b$"),
        ('<weld body1="l3" body2="box"/><weld name="b" body1="box" body2="l1"/>', "a loop, .* constraint b$"),
        ('<weld name="a" body1="l3" body2="l1"/>', "a loop, closed by equality constraint a$"),
    ],
)
def test_loops_and_couplings(constraint, message):
    links = body("l1", "0 0 0", FOLLOWER + body("l2", "1 0 0", body("l3", "1 0 0", "", "j3"), "j2"), "j1")
    tied = model(links + BOX, f"<equality>{constraint}</equality>")
    if message is None:
        assert load_mjcf(tied).joint_names == ARM
        return
    with pytest.raises(ValueError, match=message):
        load_mjcf(tied)


# --- names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("left_hand", "L_WRIST", "LARM_JOINT5", "lh_palm", "lwrist", "leftArm", "LElbow"), "left"),
        (("right_hand", "R", "RARM", "rh_ffdistal", "rwrist", "rightarm", "r_gripper"), "right"),
        (("arm", "lower_arm", "roll", "link", "torso", "ring", "rail"), ""),
    ],
)
def test_sides(names, expected):
    assert {name: side(name) for name in names} == dict.fromkeys(names, expected)


def test_names_of_tools_and_grippers():
    assert tool_rank("panda_hand_tcp") == 0 and tool_rank("grip_site") < tool_rank("tool0") < tool_rank("flange")
    assert {tool_rank(name) for name in ("wrist_3_link", "camera_tool", "gripper_link")} == {None}
    assert is_gripper_joint("l_finger", "pad") and not is_gripper_joint("j6", "gripper_base")
