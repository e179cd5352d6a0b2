"""Motions in which links touch, against the contacts of C MuJoCo."""

import mujoco
import numpy as np

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.capsules import fit_capsules
from mimic.metric.capsule_distances import colliding_pairs
from mimic.physics.mujoco_world import FLOOR, mujoco_world
from mimic.physics.world import WorldConfig
from mimic.retargeting.self_collision import make_contacts, smallest_clearances, touching_line

POSES = 400


def test_clearances_are_the_distances_of_mujocos_contacts():
    """Of the same capsules, whose contacts MuJoCo finds on its own; among the poses are many that touch."""
    config = ArmConfig(locked=[3, 6, 7])
    arm, capsules = build_arm(config, "hardware"), fit_capsules(config, "hardware")
    pairs = colliding_pairs(arm.embodiment, capsules)
    model = mujoco_world(arm, WorldConfig(gravity=True, contacts=True), capsules, pairs).model
    model.pair_margin[:] = 10.0  # reports distances, too
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    lower, upper = np.asarray(arm.embodiment.joint_range).T
    poses, expected = rng.uniform(lower, upper, (POSES, len(lower))), []
    for qpos in poses:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        expected.append(min(contact.dist for contact in data.contact if _counts(model, contact, set(pairs))))
    actual = smallest_clearances(arm.embodiment, capsules, poses[:, None])
    expected = np.array(expected)
    assert 20 < (expected < 0).sum() < POSES - 20
    np.testing.assert_allclose(actual[expected > -0.02], expected[expected > -0.02], atol=2e-4)  # 0.1 mm: smoothing
    assert np.all(actual[expected < -0.02] < 0)  # deep inside, the direction of a contact is arbitrary


def test_contacts_are_those_of_the_models_own_shapes(tmp_path):
    """Three boxes, of which the first and the third meet where the second joint folds the arm."""
    box = '<geom type="box" pos="0.5 0 0" size="0.45 0.1 0.1"/>'
    inner = f'<body name="c" pos="1 0 0"><joint name="c" axis="0 0 1"/>{box}</body>'
    middle = f'<body name="b" pos="1 0 0"><joint name="b" axis="0 0 1"/>{box}{inner}</body>'
    arm = f'<body name="a"><joint name="a" axis="0 0 1"/>{box}{middle}</body>'
    xml = f'<mujoco><compiler angle="radian"/><worldbody>{arm}</worldbody></mujoco>'
    (tmp_path / "arm.xml").write_text(xml)
    contacts = make_contacts(ArmConfig(model=str(tmp_path / "arm.xml")))
    folded, passing = [0.0, 2.0, 2.3], [0.0, np.pi / 2, np.pi / 2]  # the third box lies across the first, or beside it
    assert contacts(np.array([[0.0, 0.0, 0.0], folded, passing])).tolist() == [False, True, False]
    assert contacts(np.zeros((0, 3))).shape == (0,)
    at_home = make_contacts(ArmConfig(model=str(tmp_path / "arm.xml"), home=folded))
    assert at_home(np.array([folded, passing])).tolist() == [False, False]  # what touches in the home pose is left out


def _counts(model, contact, pairs) -> bool:
    """Whether the clearance counts a contact: one with the floor, or of a pair whose distance the joints change."""
    names = [model.geom(geom).name for geom in contact.geom]
    return FLOOR in names or tuple(sorted(int(name.removeprefix("capsule")) for name in names)) in pairs


def test_motions_that_touch_are_named():
    line = touching_line(np.array([0.02, -0.01, 0.03, -0.002]))
    assert line == (
        "warning: links touch each other or the floor in 2 of 4 demonstrations: 1, 3; smallest clearance: -10 mm"
    )
    assert touching_line(np.array([0.02])).startswith("links touch neither each other nor the floor")
