"""Capsules contain the geoms that they are fitted to, and move with their links as in C MuJoCo."""

import jax
import mujoco
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.capsules import bounding_capsule, fit_capsules
from mimic.arms.embodiment import panda_path
from mimic.metric.capsule_distances import capsule_axes, pair_distances


def distances_to_axis(points, start, end):
    axis = end - start
    along = np.clip((points - start) @ axis / max(axis @ axis, 1e-12), 0, 1)
    return np.linalg.norm(points - start - along[:, None] * axis, axis=1)


@pytest.mark.parametrize("scale", [(1, 1, 5), (1, 2, 3), (1, 1, 1), (0.1, 4, 4)])
def test_bounding_capsules_contain_all_points_and_touch_one(scale):
    for seed in range(5):
        points = np.random.default_rng(seed).normal(size=(60, 3)) * scale + 7
        start, end, radius = bounding_capsule(points)
        distances = distances_to_axis(points, start, end)
        assert np.all(distances <= radius * (1 + 1e-9)) and distances.max() > 0.999 * radius


@pytest.mark.parametrize("locked", [{}, {"joint3": 0.4, "joint6": 0.7}])
def test_distances_equal_those_of_mujoco(locked, x64):
    """The Panda's capsules, of which those of its geoms that are capsules are exact, in random poses."""
    config = ArmConfig(locked=locked)
    arm, capsules = build_arm(config).embodiment, fit_capsules(config)
    model = mujoco.MjModel.from_xml_path(panda_path())
    data = mujoco.MjData(model)
    is_capsule = [model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE for geom in range(model.ngeom)]
    pairs = [k for k, (i, j) in enumerate(capsules.pairs) if is_capsule[i] and is_capsule[j]]
    compared = 0
    distances = jax.jit(lambda qpos: pair_distances(capsules, *capsule_axes(arm, capsules, qpos)))
    for qpos in np.random.default_rng(0).uniform(-2, 2, (10, arm.num_joints)):
        for name, angle in {**dict(zip(arm.joint_names, qpos, strict=True)), **locked}.items():
            data.joint(name).qpos[0] = angle
        mujoco.mj_kinematics(model, data)
        ours = np.asarray(distances(qpos))
        for k in pairs:
            i, j = capsules.pairs[k]
            theirs = mujoco.mj_geomDistance(model, data, i, j, 10.0, None)
            if theirs > 0:  # MuJoCo measures the depth of an intersection along another direction
                compared += 1
                assert ours[k] == pytest.approx(theirs, abs=1e-6)
    assert compared > 50


def test_collision_geoms_come_first_and_neighbours_are_not_paired(tmp_path):
    geom = '<geom type="{}" size="{}" {}/>'
    (tmp_path / "arm.xml").write_text(
        "<mujoco><worldbody>"
        + "".join(
            f'<body name="b{i}" pos="0 0 0.3"><joint name="j{i}" axis="0 1 0"/>'
            + geom.format("box", "0.1 0.02 0.02", "")
            + geom.format("sphere", "0.2", 'contype="0" conaffinity="0"')
            for i in range(3)
        )
        + "</body>" * 3
        + "</worldbody></mujoco>"
    )
    capsules = fit_capsules(ArmConfig(model=str(tmp_path / "arm.xml")))
    assert capsules.joint == (0, 1, 2) and capsules.pairs == ((0, 2),)
    np.testing.assert_allclose(capsules.radius, np.hypot(0.02, 0.02), atol=1e-9)
    np.testing.assert_allclose(capsules.start[:, 2], [0.3, 0.6, 0.9], atol=1e-9)


@pytest.mark.usefixtures("unchecked")
def test_arms_without_geoms_are_rejected(tmp_path):
    (tmp_path / "bare.xml").write_text(
        '<mujoco><worldbody><body><joint name="a"/><inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/>'
        '<body pos="0 0 1"><joint name="b" axis="1 0 0"/><inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/>'
        '<site name="tip" pos="0 0 1"/></body></body></worldbody></mujoco>'
    )
    with pytest.raises(ValueError, match="has no geoms"):
        fit_capsules(ArmConfig(model=str(tmp_path / "bare.xml"), tip="tip"))
