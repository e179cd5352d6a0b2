import logging
import pathlib

import mujoco
import numpy as np
import pytest

from mimic.arms import chain
from mimic.arms.embodiment import load_arm, load_mjcf, panda, panda_path

pytestmark = pytest.mark.usefixtures("unchecked")  # bad input must meet mimic's own messages


def hinge(name="", axis="0 0 1", pos="0 0 0", inner="", body=""):
    names = [f'name="{text}"' if text else "" for text in (body, name)]
    return f'<body {names[0]} pos="{pos}"><joint {names[1]} axis="{axis}"/><geom size="0.01"/>{inner}</body>'


def model(worldbody, rest=""):
    xml = f'<mujoco model="toy"><compiler angle="radian"/><worldbody>{worldbody}</worldbody>{rest}</mujoco>'
    return mujoco.MjModel.from_xml_string(xml)


def toy(inner="", rest=""):
    """Two hinges named a and b, 1 m apart along x, then whatever is inside."""
    return model(hinge("a", body="A", inner=hinge("b", pos="1 0 0", body="B", inner=inner)), rest)


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


@pytest.mark.parametrize(
    ("inner", "end"),
    [
        (TIP, 0.5),
        ('<body pos="0.7 0 0"><geom size="0.1"/></body>' + TIP, 0.7),
        ('<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>', 0.3),
        ('<geom pos="0.2 0 0" size="0.02"/>', 0.2),
    ],
    ids=["site", "body", "capsule", "ball"],
)
def test_the_last_link_ends_at_the_farthest_point(inner, end):
    assert load_mjcf(toy(inner)).link_lengths.tolist() == pytest.approx([1, end])


@pytest.mark.parametrize("tilt", [0.0, 1e-13, 1e-9, 1e-6, 1e-3])
def test_links_that_point_backwards_have_a_frame(tilt):
    arm = load_mjcf(toy(f'<site name="tip" pos="-1 {tilt} 0"/>'))
    rotation = arm.link_rotation[-1]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-11)  # entries are exact to 1e-12
    np.testing.assert_allclose(rotation[:, 0], [-1, tilt, 0], atol=1e-6)  # cos(1e-3) = 1 - 5e-7


def test_base_and_tip():
    gripper = '<body name="finger" pos="0.4 0 0"><joint name="f" type="slide"/><geom size="0.01"/></body>' + TIP
    other = hinge("c", pos="0 1 0", body="C", inner='<site name="side" pos="0 1 0"/>')
    tree = model(hinge("a", body="A", inner=hinge("b", pos="1 0 0", body="B", inner=gripper) + other))
    assert load_mjcf(tree, tip="tip").link_lengths.tolist() == [1, 0.5]
    assert load_mjcf(tree, tip="B").joint_names == ("a", "b")
    assert load_mjcf(tree, tip="side").joint_names == ("a", "c")
    arm = load_mjcf(tree, base="A", tip="finger")
    assert (arm.joint_names, arm.link_lengths.tolist()) == (("b",), [pytest.approx(0.4)])
    assert arm.joint_anchor.tolist() == [[1, 0, 0]]  # in the frame of A


def test_unnamed_joints_get_names():
    arm = load_mjcf(model(hinge(inner=hinge(pos="1 0 0", inner=TIP))))
    assert arm.joint_names == ("joint1", "joint2")
    assert load_mjcf(model(hinge(inner=hinge(pos="1 0 0", inner=TIP))), locked=["joint2"]).num_joints == 1


def test_links_of_length_zero_are_merged_with_a_message(caplog):
    wrist = hinge("c", axis="0 1 0", inner=TIP)  # same anchor as b
    chain._warn_merged.cache_clear()
    with caplog.at_level(logging.WARNING):
        arm = load_mjcf(toy(wrist))
    assert (arm.joint_names, arm.link_names, arm.link_joint) == (("a", "b", "c"), ("link1", "link3"), (0, 2))
    assert "link2" in caplog.text and "length zero" in caplog.text


def test_only_a_locked_joint_merges_links():
    site = '<site name="{}" type="capsule" size="0.01" fromto="{}"/>'
    bent = site.format("link1", "0 0 0 0.5 0 0") + site.format("link2", "0.5 0 0 1 0.2 0")  # both on one body
    arm = model(hinge("a", inner=bent + hinge("b", pos="1 0.2 0", inner=site.format("link3", "0 0 0 0.5 0 0"))))
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
    ],
)
def test_a_torque_limit_is_that_of_the_actuator_times_its_gear(actuators, expected):
    limits = load_mjcf(toy(TIP, f"<actuator>{actuators}</actuator>")).torque_limit
    assert limits.tolist() == [expected, np.inf]


def test_a_torque_limit_of_the_joint_itself_has_no_gear():
    arm = hinge("a", inner=TIP).replace(
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


def test_links_of_a_gripper_do_not_close_a_loop():
    finger = '<body name="{0}" pos="0.1 0 0"><joint name="{0}" type="slide"/><geom size="0.01"/></body>'
    coupled = '<equality><joint joint1="l" joint2="r"/><connect body1="l" body2="r" anchor="0 0 0"/></equality>'
    assert load_mjcf(toy(finger.format("l") + finger.format("r") + TIP, coupled)).num_joints == 2


# --- bad input --------------------------------------------------------------------------------------------------------

BRANCH = hinge("a", body="A", inner=hinge("b", pos="1 0 0", body="B") + hinge("c", pos="0 1 0", body="C"))
BETWEEN = (
    '<body name="S"><joint name="s" type="slide"/><geom size="0.01"/>' + hinge("b", body="B", inner=TIP) + "</body>"
)
STATIC = '<body name="hand" pos="0.5 0 0"><geom size="0.01"/><site name="palm"/></body>'
MODELS = {
    "no joint": (lambda: model('<geom size="1"/>'), {}, "the model has no revolute joint$"),
    "slides only": (
        lambda: model('<body><joint type="slide"/><geom size="1"/></body>'),
        {},
        "the model has no revolute",
    ),
    "none behind base": (lambda: toy(TIP), {"base": "B"}, "the model has no revolute joint between base and tip"),
    "branch": (
        lambda: model(BRANCH),
        {},
        "the model branches: bodies 'B' and 'C' lead to 1 revolute joints each; name one end with tip=",
    ),
    "two arms": (
        lambda: model(hinge("a", body="A") + hinge("b", body="B")),
        {},
        "the model branches: bodies 'A' and 'B'",
    ),
    "slide": (
        lambda: model(hinge("a", body="A", inner=BETWEEN)),
        {},
        "expected revolute joints only; joint 's' on the chain is a slide: start distal to it with base=",
    ),
    "weld": (
        lambda: toy(TIP, '<equality><weld name="tie" body1="B"/></equality>'),
        {},
        "expected a serial chain; the model has a loop, closed by equality constraint tie$",
    ),
    "connect behind the last joint": (
        lambda: toy(STATIC, '<equality><connect body1="hand" body2="A" anchor="0 0 0"/></equality>'),
        {},
        "expected a serial chain; .* number 1$",
    ),
    "connect to the world": (
        lambda: toy(TIP, '<equality><connect body1="B" anchor="0 0 0"/></equality>'),
        {},
        "expected a serial chain; .* number 1$",
    ),
    "coupled joints": (
        lambda: toy(TIP, '<equality><joint joint1="a" joint2="b"/></equality>'),
        {},
        "expected a serial chain; .* number 1$",
    ),
    "unknown base": (lambda: toy(TIP), {"base": "C"}, "the model has no body 'C'; valid are A, B$"),
    "unknown tip": (
        lambda: toy(TIP),
        {"tip": "top"},
        "the model has no body 'top'; valid are A, B, nor a site of that name; valid are tip$",
    ),
    "no link": (lambda: model('<body><joint/><geom size="1"/></body>'), {}, "the arm has no link of a length above"),
    "names clash": (
        lambda: model(hinge("joint2", inner=hinge(pos="1 0 0", inner=TIP))),
        {},
        "two joints of the chain are called joint2; name the unnamed ones",
    ),
}


@pytest.mark.parametrize("case", MODELS)
def test_bad_models_are_refused(case):
    make, options, message = MODELS[case]
    with pytest.raises(ValueError, match=f"^{message}") as error:
        load_mjcf(make(), **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("active", [True, False])
def test_an_active_loop_between_sites_is_refused(active):
    arm = hinge("a", body="A", inner=hinge("b", pos="1 0 0", body="B", inner=STATIC))
    weld = f'<equality><weld name="tie" site1="palm" site2="wall" active="{str(active).lower()}"/></equality>'
    tied = model('<site name="wall"/>' + arm, weld)
    if not active:
        assert load_mjcf(tied).num_joints == 2
        return
    with pytest.raises(ValueError, match="the model has a loop, closed by equality constraint tie$"):
        load_mjcf(tied)


FILES = {
    "missing": (None, "no MJCF or URDF file at '.*arm.xml'$"),
    "empty": ("", "'.*arm.xml' is not an MJCF or URDF model that MuJoCo can read: "),
    "not xml": ("joint1 = 3", "'.*arm.xml' is not an MJCF or URDF model that MuJoCo can read: "),
    "not mjcf": ("<html><body/></html>", "'.*arm.xml' is not an MJCF or URDF model that MuJoCo can read: "),
    "broken": ("<mujoco><worldbody><body>", "'.*arm.xml' is not an MJCF or URDF model that MuJoCo can read: "),
    "misspelt": ("<mujoco><worldbody><boby/></worldbody></mujoco>", "'.*arm.xml' is not an MJCF or URDF model .*boby"),
}


@pytest.mark.parametrize("case", FILES)
def test_bad_files_are_refused(tmp_path, case):
    content, message = FILES[case]
    path = tmp_path / "arm.xml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ValueError, match=f"^{message}") as error:
        load_mjcf(path)
    assert "\n" not in str(error.value)


def test_a_directory_is_no_file(tmp_path):
    with pytest.raises(ValueError, match="^no MJCF or URDF file at "):
        load_mjcf(tmp_path)
