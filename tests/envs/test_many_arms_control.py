"""Torques that bring any arm to target angles."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arm import torque_scale as scale_of_one_arm
from mimic.arms.arrays import MAX_JOINTS, arm_arrays, lock_joints
from mimic.envs import many_arms_control as control
from mimic.physics.composite_kernel import make_advance
from mimic.retargeting.array_nearest import NearestPose

DT = 0.1
UNLIMITED: Any = np.full(MAX_JOINTS, 1e9)
LOCKED = np.array([0, 0, 1, 0, 0, 1, 1, 0])


def targets_at(qpos, qvel):
    return NearestPose(qpos, qvel, jnp.ones(MAX_JOINTS))


def tracking_torque(arm, qpos, qvel, targets, max_torque):
    plan = control.make_plan(arm, qpos, qvel, targets, arm.velocity_limit, DT)
    return control.planned_torque(arm, plan, jnp.zeros(MAX_JOINTS), max_torque, DT)


@pytest.fixture(scope="module")
def panda():
    return arm_arrays(build_arm(ArmConfig()))


def test_the_maximum_torque_is_that_of_one_arm(x64, panda):
    """Also of a locked arm, whose own model has fewer joints; its table is in single precision."""
    for mask, config in ((np.zeros(MAX_JOINTS), ArmConfig()), (LOCKED, ArmConfig(locked=[3, 6, 7]))):
        arm, free = lock_joints(panda, mask), np.flatnonzero((mask == 0)[:7])
        torque = np.asarray(control.torque_scale(arm, 3.0, DT))
        np.testing.assert_allclose(torque[free], scale_of_one_arm(build_arm(config), 3.0, DT), rtol=1e-6)
        assert not np.delete(torque, free).any()


@pytest.mark.parametrize("mask", [np.zeros(MAX_JOINTS), LOCKED])
def test_targets_of_a_constant_acceleration_are_reached(x64, panda, mask):
    """To what the inertia changes within a step, while joints move by 0.05 rad."""
    arm = lock_joints(panda, mask)
    rng = np.random.default_rng(0)
    qpos, qvel, qacc = (jnp.asarray(x * arm.is_free) for x in rng.uniform(-1, 1, (3, MAX_JOINTS)))
    qvel, qacc = 0.3 * qvel, 3.0 * qacc
    targets = targets_at(qpos + DT * qvel + 0.5 * DT**2 * qacc, qvel + DT * qacc)
    torque = tracking_torque(arm, qpos, qvel, targets, UNLIMITED)
    end = make_advance(DT / 10, 10)(arm, qpos, qvel, torque)
    np.testing.assert_allclose(end[0], targets.qpos, rtol=0, atol=2e-3)
    np.testing.assert_allclose(end[1], targets.qvel, rtol=0, atol=4e-2)


def test_torques_above_the_maximum_keep_their_direction(x64, panda):
    qpos = jnp.zeros(MAX_JOINTS)
    targets = targets_at(qpos + 1.0 * panda.is_free, qpos)
    free = tracking_torque(panda, qpos, qpos, targets, UNLIMITED)
    maximum = control.torque_scale(panda, 0.2, DT)
    limited = tracking_torque(panda, qpos, qpos, targets, maximum)
    ratio = np.asarray(limited / maximum)[:7]
    assert np.abs(ratio).max() == pytest.approx(1.0)
    np.testing.assert_allclose(limited / free[0] * free[0] / limited[0], free / free[0], rtol=1e-12)


@pytest.mark.slow
def test_far_targets_are_approached_at_the_velocity_limit_and_braked_before(x64, panda):
    """The angle never overshoots a target at rest by more than a step's rounding of the braking distance."""
    arm = lock_joints(panda, np.array([1, 0, 1, 1, 1, 1, 1, 0]))
    target = targets_at(jnp.full(MAX_JOINTS, 1.5) * arm.is_free, jnp.zeros(MAX_JOINTS))
    advance = jax.jit(make_advance(DT / 10, 10))
    qpos = qvel = jnp.zeros(MAX_JOINTS)
    angles, speeds = [], []
    for _ in range(25):
        torque = tracking_torque(arm, qpos, qvel, target, control.torque_scale(arm, 1.0, DT))
        qpos, qvel = advance(arm, qpos, qvel, torque)
        angles.append(float(qpos[1]))
        speeds.append(float(qvel[1]))
    assert max(speeds) < 1.5 * panda.velocity_limit[1] and max(speeds) > 0.7 * panda.velocity_limit[1]
    assert max(angles) < 1.53 and angles[-1] == pytest.approx(1.5, abs=1e-3)
