import logging
import pathlib

import mujoco
import numpy as np
import pytest

from mimic.arms import chain, mujoco_chain
from mimic.arms.embodiment import load_arm, load_mjcf, panda, panda_path
from mimic.arms.model_copy import copied_files
from mimic.arms.model_source import read_source
from mimic.metric.kinematics import link_states

pytestmark = pytest.mark.usefixtures("unchecked")  # the messages are those of mimic


def revolute(name="", axis="0 0 1", pos="0 0 0", inner="", body=""):
    names = [f'name="{text}"' if text else "" for text in (body, name)]
    return f'<body {names[0]} pos="{pos}"><joint {names[1]} axis="{axis}"/><geom size="0.01"/>{inner}</body>'


def model(worldbody, rest=""):
    xml = f'<mujoco model="toy"><compiler angle="radian"/><worldbody>{worldbody}</worldbody>{rest}</mujoco>'
    return mujoco.MjModel.from_xml_string(xml)


def toy(inner="", rest=""):
    """Two revolute joints named a and b, 1 m apart along x, then what `inner` describes."""
    return model(revolute("a", body="A", inner=revolute("b", pos="1 0 0", body="B", inner=inner)), rest)


TIP = '<site name="tip" pos="0.5 0 0"/>'


def test_mjcf_from_path_or_model():
    arms = [load_mjcf(source) for source in (panda_path(), pathlib.Path(panda_path()))]
    arms.append(load_mjcf(mujoco.MjModel.from_xml_path(panda_path())))
    for arm in arms:
        assert arm.name == "panda"
        np.testing.assert_array_equal(arm.link_position, panda().link_position)
        np.testing.assert_array_equal(arm.joint_range, panda(limits="hardware").joint_range)
        np.testing.assert_array_equal(arm.home, panda(limits="hardware").home)
    # load_mjcf locks at 0; load_arm, as the environments do, where the arm starts
    np.testing.assert_array_equal(load_mjcf(panda_path(), locked=[4]).link_position, panda(locked=[4]).link_position)
    ready, _, angles = load_arm(panda_path(), locked=[4])
    assert angles == {"joint4": panda(limits="hardware").home[3]} and ready.num_joints == 6


def test_links_run_from_anchor_to_anchor_to_tip():
    arm = load_mjcf(toy(TIP))
    assert (arm.name, arm.joint_names, arm.link_names) == ("toy", ("a", "b"), ("link1", "link2"))
    assert arm.link_position.tolist() == [[0.5, 0, 0], [1.25, 0, 0]]
    assert arm.link_lengths.tolist() == [1, 0.5]
    assert np.isinf(arm.torque_limit).all()


@pytest.mark.parametrize("tilt", [0.0, 1e-13, 1e-9, 1e-6, 1e-3])
def test_links_that_point_backwards_have_a_frame(tilt):
    arm = load_mjcf(toy(f'<site name="tip" pos="-1 {tilt} 0"/>'))
    rotation = arm.link_rotation[-1]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-11)  # entries are exact to 1e-12
    np.testing.assert_allclose(rotation[:, 0], [-1, tilt, 0], atol=1e-6)  # cos(1e-3) = 1 - 5e-7


def test_base_and_tip():
    gripper = '<body name="finger" pos="0.4 0 0"><joint name="f" type="slide"/><geom size="0.01"/></body>' + TIP
    other = revolute("c", pos="0 1 0", body="C", inner='<site name="side" pos="0 1 0"/>')
    tree = model(revolute("a", body="A", inner=revolute("b", pos="1 0 0", body="B", inner=gripper) + other))
    assert load_mjcf(tree, tip="tip").link_lengths.tolist() == [1, 0.5]
    assert load_mjcf(tree, tip="B").joint_names == ("a", "b")
    assert load_mjcf(tree, tip="side").joint_names == ("a", "c")
    arm = load_mjcf(tree, base="A", tip="finger")
    assert (arm.joint_names, arm.link_names) == (("b",), ("base", "link1"))
    assert arm.link_lengths.tolist() == [1, pytest.approx(0.4)]
    assert arm.joint_anchor.tolist() == [[1, 0, 0]]  # in the frame of A


def on_a_base(offset, axis="0 0 1"):
    """The joints a and b of a toy on a body that is not at the world's origin."""
    arm = revolute("a", pos=offset, axis=axis, body="A", inner=revolute("b", pos="1 0 0", axis="0 1 0", inner=TIP))
    return model(f'<body name="plate" pos="2 3 0.5" euler="0 0 1">{arm}</body>')


@pytest.mark.parametrize(("name", "x"), [("base_link", -1), ("mount", 1)])
def test_the_base_is_the_body_whose_inertia_another_one_carries(name, x):
    """UR's base_link_inertia is turned by half a revolution in base_link; in other bodies such a name says nothing."""
    arm = revolute("a", body="A", inner=revolute("b", pos="1 0 0", body="B", inner=TIP))
    turned = f'<body name="base_link_inertia" quat="0 0 0 1">{arm}</body>'
    found = load_mjcf(model(f'<body name="{name}">{turned}</body>'))
    np.testing.assert_allclose(found.joint_anchor[1], [x, 0, 0], atol=1e-12)
    np.testing.assert_allclose(found.segment_end[-1], [1.5 * x, 0, 0], atol=1e-12)


def test_the_first_link_starts_at_the_base():
    arm = load_mjcf(on_a_base("0 0 0.3"))
    assert (arm.link_names, arm.num_joints) == (("base", "link1", "link2"), 2)
    np.testing.assert_allclose(arm.link_position, [[0, 0, 0.15], [0.5, 0, 0.3], [1.25, 0, 0.3]], atol=1e-12)
    np.testing.assert_allclose(arm.link_lengths, [0.3, 1, 0.5], atol=1e-12)
    states = link_states(arm, np.array([np.pi / 2, 0.0]), np.array([2.0, 0.0]), normalized=False)
    assert states.direction is not None and states.angular_velocity is not None
    atol = 1e-6  # float32
    np.testing.assert_allclose(states.position, [[0, 0, 0.15], [0, 0.5, 0.3], [0, 1.25, 0.3]], atol=atol)
    np.testing.assert_allclose(states.direction, [[0, 0, 1], [0, 1, 0], [0, 1, 0]], atol=atol)
    np.testing.assert_allclose(states.linear_velocity, [[0, 0, 0], [-1, 0, 0], [-2.5, 0, 0]], atol=atol)
    np.testing.assert_allclose(states.angular_velocity, [[0, 0, 2]] * 3, atol=atol)  # as the Panda's first link
    locked = load_mjcf(on_a_base("0 0 0.3"), locked={"a": 0.2})
    assert (locked.link_names, locked.link_joint) == (arm.link_names, (-1, -1, 0))


def test_a_base_segment_that_is_not_along_the_first_axis_does_not_move():
    arm = load_mjcf(on_a_base("0.3 0 0.4"))
    assert arm.link_joint == (-1, 0, 1) and arm.link_lengths[0] == pytest.approx(0.5)
    states = link_states(arm, np.array([1.0, 0.5]), np.array([2.0, 1.0]), normalized=False)
    np.testing.assert_allclose(states.position[0], [0.15, 0, 0.2], atol=1e-7)
    assert states.direction is not None and states.angular_velocity is not None
    np.testing.assert_allclose(states.direction[0], [0.6, 0, 0.8], atol=1e-7)
    assert not np.any(states.linear_velocity[0]) and not np.any(states.angular_velocity[0])


@pytest.mark.parametrize(
    ("arm", "options", "names"),
    [
        (on_a_base("0 0 0.3"), {"links": "merged"}, ("link1", "link2")),  # paper: as many links as joints
        (on_a_base("0 0 0"), {}, ("link1", "link2")),
        (model(revolute("a", pos="0 0 0.3", inner=TIP)), {}, ("link1",)),  # on the world, which is no part of an arm
        (model(revolute("a", pos="0 0 0.3", inner=TIP)), {"base": "world"}, ("base", "link1")),
    ],
    ids=["merged", "joint at the base", "world", "named world"],
)
def test_arms_without_a_base_segment(arm, options, names):
    assert load_mjcf(arm, **options).link_names == names


def test_links_that_the_model_marks_are_all_its_links():
    site = '<site name="link1" type="capsule" size="0.01" fromto="0 0 0 0.5 0 0"/>'
    marked = model(f'<body name="plate">{revolute("a", pos="0 0 0.3", inner=site)}</body>')
    assert load_mjcf(marked, base="plate").link_names == ("link1",)


def test_links_of_length_zero_are_merged_with_a_message(caplog):
    wrist = revolute("c", axis="0 1 0", inner=TIP)  # same anchor as b
    chain._warn_merged.cache_clear()
    with caplog.at_level(logging.WARNING):
        arm = load_mjcf(toy(wrist))
    assert (arm.joint_names, arm.link_names, arm.link_joint) == (("a", "b", "c"), ("link1", "link3"), (0, 2))
    assert "link2" in caplog.text and "length zero" in caplog.text


def test_only_a_locked_joint_merges_links():
    site = '<site name="{}" type="capsule" size="0.01" fromto="{}"/>'
    bent = site.format("link1", "0 0 0 0.5 0 0") + site.format("link2", "0.5 0 0 1 0.2 0")  # both on one body
    arm = model(revolute("a", inner=bent + revolute("b", pos="1 0.2 0", inner=site.format("link3", "0 0 0 0.5 0 0"))))
    assert load_mjcf(arm).link_names == ("link1", "link2", "link3")
    assert load_mjcf(arm, locked="b", links="merged").link_names == ("link1", "link2+link3")
    assert load_mjcf(arm, locked="b", links="kept").link_names == ("link1", "link2", "link3")


@pytest.mark.parametrize(
    ("actuators", "expected"),
    [
        ('<motor joint="a" gear="2" ctrllimited="true" ctrlrange="-3 4"/>', 8),
        ('<motor joint="a" gear="-3" forcelimited="true" forcerange="-5 4"/>', 15),
        ('<position joint="a" gear="3" kp="100" forcelimited="true" forcerange="-7 7"/>', 21),
        ('<position joint="a" gear="3" kp="100" ctrllimited="true" ctrlrange="-2 2"/>', np.inf),  # a range of angles
        ('<general joint="a" gear="2" gainprm="-10" ctrllimited="true" ctrlrange="-1 1"/>', 20),
        ('<motor joint="a" gear="2" ctrllimited="true" ctrlrange="-9 9" forcelimited="true" forcerange="-5 5"/>', 10),
        ('<motor joint="a" ctrllimited="true" ctrlrange="-9 9"/><motor joint="b" gear="5"/>', 9),
        ('<motor jointinparent="a" ctrllimited="true" ctrlrange="-9 9"/>', 9),
        ('<damper joint="a" kv="1" ctrlrange="0 2"/>', np.inf),  # brakes alone
    ],
)
def test_a_torque_limit_is_that_of_the_actuator_times_its_gear(actuators, expected):
    limits = load_mjcf(toy(TIP, f"<actuator>{actuators}</actuator>")).torque_limit
    assert limits.tolist() == [expected, np.inf]


def test_a_torque_limit_of_the_joint_itself_has_no_gear():
    arm = revolute("a", inner=TIP).replace(
        'axis="0 0 1"', 'axis="0 0 1" actuatorfrclimited="true" actuatorfrcrange="-6 6"'
    )
    for motor_limit, expected in ((4, 6), (2, 4)):  # of a motor with a gear of 2
        motor = f'<motor joint="a" gear="2" ctrllimited="true" ctrlrange="-{motor_limit} {motor_limit}"/>'
        assert load_mjcf(model(arm, f"<actuator>{motor}</actuator>")).torque_limit.tolist() == [expected]


def test_velocity_limits_and_the_start_pose_come_from_the_model():
    limits = '<custom><numeric name="velocity_limit" data="1.5 2.5"/></custom>'
    assert load_mjcf(toy(TIP, limits)).velocity_limit.tolist() == [1.5, 2.5]
    narrow = '<body><joint range="0.5 1" limited="true"/><geom size="1" pos="1 0 0"/></body>'
    arm = load_mjcf(model(narrow))
    assert (arm.joint_range.tolist(), arm.home.tolist()) == ([[0.5, 1]], [0.5])


CHILD = revolute("a", body="A", inner=revolute("b", pos="1 0 0", body="B", inner=TIP))


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [("1 2", [1, 2]), ("9 1 2", [1, 2]), ("1", None), ("1 2 3 4", None)],
    ids=["of the revolute joints", "of all joints", "too few", "too many"],
)
def test_velocity_limits_of_an_arm_on_a_lift(numbers, expected):
    lift = f'<body name="cart"><joint name="lift" type="slide"/><geom size="1"/>{CHILD}</body>'
    numeric = f'<custom><numeric name="velocity_limit" data="{numbers}"/></custom>'
    if expected:
        assert load_mjcf(model(lift, numeric)).velocity_limit.tolist() == expected
        return
    with pytest.raises(ValueError, match="in velocity_limit; expected one for each of 3 joints, or .* the 2 revolute"):
        load_mjcf(model(lift, numeric))


def test_the_rotation_of_a_base_that_slides_along_two_axes_is_no_joint_of_the_arm():
    base = "".join(f'<joint name="{axis}" type="slide" axis="{vector}"/>' for axis, vector in
                   (("x", "1 0 0"), ("y", "0 1 0")))  # fmt: skip
    arm = load_mjcf(model(f'<body name="cart">{base}<joint name="yaw"/><geom size="1"/>{CHILD}</body>'))
    assert arm.joint_names == ("a", "b")


@pytest.mark.parametrize(("metres", "is_odd"), [(1.0, False), (1000.0, True), (0.001, True)])
def test_an_arm_of_another_size_than_arms_have_is_a_warning(caplog, metres, is_odd):
    mujoco_chain._warn_size.cache_clear()
    load_mjcf(model(revolute("a", inner=f'<site name="tip" pos="{metres} 0 0"/>')))
    assert (f"are {metres:.3g} m long together: is its file in metres" in caplog.text) == is_odd


def test_an_included_file_may_be_beside_the_one_that_includes_it(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts/arm.xml").write_text(f"<mujocoinclude>{CHILD}</mujocoinclude>")
    (tmp_path / "parts/all.xml").write_text('<mujocoinclude><include file="arm.xml"/></mujocoinclude>')
    (tmp_path / "robot.xml").write_text('<mujoco><worldbody><include file="parts/all.xml"/></worldbody></mujoco>')
    assert load_mjcf(tmp_path / "robot.xml").joint_names == ("a", "b")
    (tmp_path / "arm.xml").write_text(f"<mujocoinclude>{revolute('c', inner=TIP)}</mujocoinclude>")
    assert load_mjcf(tmp_path / "robot.xml").joint_names == ("c",)  # beside the model counts first, as in MuJoCo


def test_a_range_that_mujoco_ignores_is_a_line(tmp_path, caplog):
    (tmp_path / "arm.xml").write_text(
        '<mujoco><compiler angle="radian"/><worldbody><body><joint name="a" range="2 -2"/>'
        '<geom size="0.1" pos="1 0 0"/></body></worldbody></mujoco>'
    )
    assert load_mjcf(tmp_path / "arm.xml").joint_range[0] == pytest.approx((-np.pi, np.pi))
    assert "the range of joint 'a' goes from 2 down to -2: none is assumed" in caplog.text


def test_attached_models_keep_their_velocity_limits_and_start_poses(tmp_path):
    rest = '<custom><numeric name="velocity_limit" data="{0} 2"/></custom>'
    rest += '<keyframe><key name="home" qpos="0.{0} 0.2"/></keyframe>'
    for name, number in (("one", 1), ("two", 3)):
        xml = f'<mujoco><compiler angle="radian"/><worldbody>{CHILD}</worldbody>{rest.format(number)}</mujoco>'
        (tmp_path / f"{name}.xml").write_text(xml)
    assets = "".join(f'<model name="{name}" file="{name}.xml"/>' for name in ("one", "two"))
    attached = "".join(f'<attach model="{name}" body="A" prefix="{name}_"/>' for name in ("one", "two"))
    (tmp_path / "pair.xml").write_text(
        f"<mujoco><asset>{assets}</asset><worldbody><frame>{attached}</frame></worldbody></mujoco>"
    )
    arm = load_mjcf(tmp_path / "pair.xml", tip=["one_tip", "two_tip"])
    assert arm.joint_names == ("one_a", "one_b", "two_a", "two_b")
    assert arm.velocity_limit.tolist() == [1, 2, 3, 2] and arm.home.tolist() == [0.1, 0.2, 0.3, 0.2]
    (tmp_path / "copy").mkdir()
    for name, content in copied_files(read_source(tmp_path / "pair.xml"), "pair.xml").items():
        (tmp_path / "copy" / name).write_bytes(content)
    copied = load_mjcf(tmp_path / "copy" / "pair.xml", tip=["one_tip", "two_tip"])
    assert copied.velocity_limit.tolist() == [1, 2, 3, 2]


def test_links_of_a_gripper_do_not_close_a_loop():
    finger = '<body name="{0}" pos="0.1 0 0"><joint name="{0}" type="slide"/><geom size="0.01"/></body>'
    coupled = '<equality><joint joint1="l" joint2="r"/><connect body1="l" body2="r" anchor="0 0 0"/></equality>'
    assert load_mjcf(toy(finger.format("l") + finger.format("r") + TIP, coupled)).num_joints == 2


# --- bad input --------------------------------------------------------------------------------------------------------

BRANCH = revolute("a", body="A", inner=revolute("b", pos="1 0 0", body="B") + revolute("c", pos="0 1 0", body="C"))
BETWEEN = (
    '<body name="S"><joint name="s" type="slide"/><geom size="0.01"/>' + revolute("b", body="B", inner=TIP) + "</body>"
)
STATIC = '<body name="hand" pos="0.5 0 0"><geom size="0.01"/><site name="palm"/></body>'
MODELS = {
    "no joint": (lambda: model('<geom size="1"/>'), {}, "the model has no revolute joint$"),
    "branch": (
        lambda: model(BRANCH),
        {},
        "the model branches: 2 chains of 2 revolute joints end at 'B', 'C'; name one, as in tip=B, several, as in "
        r'tip=\[B,C\], or all ends of the model with tip=\["\*"\]$',
    ),
    "slide": (
        lambda: model(revolute("a", body="A", inner=BETWEEN)),
        {},
        "expected revolute joints only; joint 's' on the chain is a slide: start distal to it with base=",
    ),
    "connect behind the last joint": (
        lambda: toy(STATIC, '<equality><connect body1="hand" body2="A" anchor="0 0 0"/></equality>'),
        {},
        "expected a chain or a tree; .* number 1$",
    ),
    "unknown base": (lambda: toy(TIP), {"base": "C"}, "base: expected a body of the model, A, B, got 'C'$"),
    "unknown tip": (
        lambda: toy(TIP),
        {"tip": "top"},
        "tip: expected a body or site of the model, A, B, tip, got 'top'; did you mean tip.$",
    ),
    "no link": (lambda: model('<body><joint/><geom size="1"/></body>'), {}, "the arm has no link of a length above"),
    "names clash": (
        lambda: model(revolute("joint2", inner=revolute(pos="1 0 0", inner=TIP))),
        {},
        "two joints of the chain are called joint2; name the unnamed ones",
    ),
}


@pytest.mark.parametrize("case", MODELS)
def test_bad_models_are_rejected(case):
    make, options, message = MODELS[case]
    with pytest.raises(ValueError, match=f"^{message}") as error:
        load_mjcf(make(), **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("active", [True, False])
def test_an_active_loop_between_sites_is_rejected(active):
    arm = revolute("a", body="A", inner=revolute("b", pos="1 0 0", body="B", inner=STATIC))
    weld = f'<equality><weld name="tie" site1="palm" site2="wall" active="{str(active).lower()}"/></equality>'
    tied = model('<site name="wall"/>' + arm, weld)
    if not active:
        assert load_mjcf(tied).num_joints == 2
        return
    with pytest.raises(ValueError, match="the model has a loop, closed by equality constraint tie$"):
        load_mjcf(tied)
