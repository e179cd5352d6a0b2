"""The inner loop with Python's numbers is that of `mimic.control.joint_control`, on which policies are trained."""

import numpy as np
import pytest

from mimic.control.joint_control import (
    JointParameters,
    Reference,
    Target,
    joint_torque,
    next_reference,
    reference_limits,
)
from mimic.deploy.inner_loop import InnerLoop
from tests.helpers.bundles import parameters

JOINTS, ROBOTS, PERIODS = 7, 5, 400


def joint_parameters():
    return JointParameters(*(np.tile(x[:, None], ROBOTS) for x in parameters()))


@pytest.mark.parametrize("mode", ["joint_velocity", "joint_position", "joint_impedance"])
def test_references_and_torques_are_those_of_the_arrays(mode):
    """Of robots with random targets, some of which brake; from references that are up to 0.1 rad beyond the range."""
    joints, rng, size = joint_parameters(), np.random.default_rng(0), (JOINTS, ROBOTS)
    limits, is_position = reference_limits(joints), mode != "joint_velocity"
    loop = InnerLoop(joints, is_position, np.full(size, np.inf))
    span = joints.upper - joints.lower
    reference = Reference(joints.lower - 0.1 + (span + 0.2) * rng.uniform(size=size), *rng.uniform(-1, 1, (2, *size)))
    torque, held, stops = np.zeros(size), np.ones(ROBOTS, bool), 0
    value, stiffness = np.zeros((2, *size))
    loop.set_reference(reference)
    for period in range(PERIODS):
        if period % 50 == 0:
            position = joints.lower - 0.1 + (span + 0.2) * rng.uniform(size=size)
            value = position if is_position else 1.2 * joints.velocity * rng.uniform(-1, 1, size)
            stiffness = rng.uniform(0.5, 1, size) if mode == "joint_impedance" else np.ones(size)
            held = rng.uniform(size=ROBOTS) < 0.7
            loop.set_targets(value, stiffness)
        towards = next_reference(mode, reference, value, limits, np)
        braking = next_reference("joint_velocity", reference, np.zeros(size), limits, np)
        reference = Reference(*(np.where(held, x, y) for x, y in zip(towards, braking, strict=True)))
        inside = np.clip(reference.qpos + rng.normal(0, 0.02, size), joints.lower, joints.upper)
        qvel = reference.qvel + rng.normal(0, 0.1, size)
        torque = joint_torque(mode, inside, qvel, reference, Target(value, stiffness), torque, joints, np)
        loop.period(inside.ravel().tolist(), qvel.ravel().tolist(), held.tolist() * JOINTS, [False] * JOINTS * ROBOTS)
        np.testing.assert_allclose(np.array(loop.reference), np.array(reference), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(loop.torque, torque, rtol=1e-12, atol=1e-12)
        stops += np.count_nonzero(~held)
    assert np.ptp(reference.qpos) > 1 and 0 < stops < PERIODS * ROBOTS


def test_an_arm_that_is_not_measured_gets_the_torque_of_its_references_motion():
    joints, rng = joint_parameters(), np.random.default_rng(1)
    loop, size = InnerLoop(joints, False, joints.velocity), (JOINTS, ROBOTS)
    loop.set_reference(Reference(np.zeros(size), 0.1 * rng.uniform(-1, 1, size), np.zeros(size)))
    unknown, is_lost = [np.nan] * JOINTS * ROBOTS, [True, False, False, False, False] * JOINTS
    for _ in range(5):
        loop.period(unknown, unknown, [False] * JOINTS * ROBOTS, is_lost)
    reference = loop.reference
    expected = joints.inertia * reference.qacc + joints.friction * reference.qvel
    change = 5e-3 * joints.torque_rate
    np.testing.assert_allclose(loop.torque[:, 0], np.clip(expected, -change, change)[:, 0], rtol=0.1)
    assert np.isfinite(loop.torque[:, 0]).all() and np.isnan(loop.torque[:, 1:]).all()
