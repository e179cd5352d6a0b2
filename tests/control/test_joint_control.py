"""The inner loop: whatever a policy commands, the reference and the torque stay within the manufacturer's limits."""

import jax.numpy as jnp
import numpy as np
import pytest

from mimic.control import joint_control
from mimic.control.joint_control import MODES, PERIOD, JointParameters, Reference
from mimic.control.limits import JointLimits, joint_limits, joint_parameters

JOINTS = 7
RANGE = np.array([[-2.9, 2.9], [-1.76, 1.76], [-2.9, 2.9], [-3.07, -0.07], [-2.9, 2.9], [-0.02, 3.75], [-2.9, 2.9]])

INERTIA = np.linspace(1.4, 0.1, JOINTS)


def panda_limits() -> JointLimits:
    return joint_limits(
        RANGE,
        np.array([2.175] * 4 + [2.61] * 3),
        np.array([87.0] * 4 + [12.0] * 3),
        np.array([15, 7.5, 10, 12.5, 15, 20, 20.0]),
        np.array([7500, 3750, 5000, 6250, 7500, 10000, 10000.0]),
        np.full(7, 1000.0),
    )


def parameters() -> JointParameters:
    return joint_parameters(panda_limits(), (INERTIA, 4 * INERTIA), np.ones(JOINTS), np.full(JOINTS, 5.0), 0.05)


def start() -> Reference:
    return Reference(RANGE.mean(axis=1), np.zeros(JOINTS), np.zeros(JOINTS))


@pytest.mark.parametrize("mode", [mode for mode in MODES if mode != "torque"])
@pytest.mark.parametrize("hold", [1, 7, 50, 700])  # periods of a target: from noise to ramps into the joint limits
def test_reference_stays_within_the_manufacturers_limits(mode: str, hold: int) -> None:
    limits, joints, reference = panda_limits(), parameters(), start()
    working = joint_control.reference_limits(joints)
    rng, rows = np.random.default_rng(hold), []
    for step in range(max(2000, 10 * hold)):
        if step % hold == 0:
            action = rng.choice([-1.0, 1.0, 0.3, 0.0], JOINTS)
            target = joint_control.action_target(mode, action, reference, joints, np)
        reference = joint_control.next_reference(mode, reference, target, working, np)
        rows.append(reference)
    qpos, qvel, qacc = (np.stack(x) for x in zip(*rows, strict=True))
    assert np.all((qpos > limits.position[:, 0]) & (qpos < limits.position[:, 1]))
    assert np.abs(qvel / limits.velocity).max() < 1
    assert np.abs(qacc / limits.acceleration).max() < 1
    assert np.abs(np.diff(qacc, axis=0) / PERIOD / limits.jerk).max() < 1
    # The limits are used, not only kept.
    if hold >= 50 and mode == "joint_velocity":
        assert np.abs(qvel / limits.velocity).max() > 0.7
    if hold == 700 and mode == "joint_velocity":
        assert qpos.max(axis=0)[0] > limits.position[0, 1] - 0.06


def test_reference_reaches_a_target_angle_without_overshoot() -> None:
    joints, reference = parameters(), start()
    target, largest = reference.qpos + 0.5, np.full(JOINTS, -np.inf)
    for _ in range(3000):
        reference = joint_control.next_reference(
            "joint_position", reference, target, joint_control.reference_limits(joints), np
        )
        largest = np.maximum(largest, reference.qpos)
    np.testing.assert_allclose(reference.qpos, target, atol=1e-4)
    assert np.all(largest < target + 1e-3)


def test_torque_changes_at_most_at_its_rate() -> None:
    limits, joints, reference = panda_limits(), parameters(), start()
    rng, torque = np.random.default_rng(0), np.zeros(JOINTS)
    for _ in range(500):
        target = rng.uniform(-500, 500, JOINTS)
        qpos = reference.qpos + rng.normal(size=JOINTS)
        for mode in ("torque", "joint_position"):
            after = joint_control.joint_torque(mode, qpos, np.zeros(JOINTS), reference, target, torque, joints, np)
            assert np.all(np.abs(after - torque) <= limits.torque_rate * PERIOD)
            assert np.all(np.abs(after) <= limits.torque)
            torque = after


def test_the_torque_is_critically_damped_control_of_the_reference() -> None:
    unlimited = np.full(JOINTS, 1e9)
    joints = parameters()._replace(torque=unlimited, torque_rate=unlimited)
    np.testing.assert_allclose(joints.damping**2, 4 * joints.stiffness * joints.inertia)
    reference = Reference(*(np.full(JOINTS, value) for value in (0.01, 0.2, 3.0)))
    rest = np.zeros(JOINTS)
    torque = joint_control.joint_torque("joint_position", rest, rest, reference, rest, rest, joints, np)
    expected = joints.stiffness * 0.01 + joints.damping * 0.2 + joints.inertia * 3.0 + joints.friction * 0.2
    np.testing.assert_allclose(torque, expected)


@pytest.mark.parametrize("mode", ["joint_velocity", "joint_position"])
def test_an_action_towards_an_angle_has_the_target_that_leads_there(mode: str) -> None:
    joints, reference, duration = parameters(), start(), 0.2
    displacement = 0.05 * np.random.default_rng(0).uniform(-1, 1, len(reference.qpos))
    action = joint_control.action_towards(mode, displacement, duration, joints, np)
    target = joint_control.action_target(mode, action, reference, joints, np)
    moved = target * duration if mode == "joint_velocity" else target - reference.qpos
    np.testing.assert_allclose(moved, displacement, atol=1e-12)
    many = np.stack([displacement, 100 * displacement])
    actions = joint_control.action_towards(mode, many, duration, joints, np)
    np.testing.assert_array_equal(actions[0], action)
    assert np.abs(actions[1]).max() == 1.0


@pytest.mark.parametrize("mode", MODES)
def test_jax_and_numpy_agree(mode: str) -> None:
    """Both run the same code; float32 rounds an angle of 3 rad to 2e-7, which adds up, and gains multiply by 1600."""
    joints, rng = parameters(), np.random.default_rng(1)
    results = []
    for xp, dtype in ((np, np.float64), (jnp, np.float32)):
        rng = np.random.default_rng(1)
        values = JointParameters(*(xp.asarray(x, dtype) for x in joints))
        reference = Reference(*(xp.asarray(x, dtype) for x in start()))
        torque = xp.zeros(JOINTS, dtype)
        for _ in range(5):
            action = xp.asarray(rng.uniform(-1, 1, JOINTS), dtype)
            target = joint_control.action_target(mode, action, reference, values, xp)
            for _ in range(10):
                if mode != "torque":
                    reference = joint_control.next_reference(
                        mode, reference, target, joint_control.reference_limits(values), xp
                    )
                torque = joint_control.joint_torque(
                    mode, reference.qpos, reference.qvel * 0, reference, target, torque, values, xp
                )
        results.append((np.asarray(reference.qpos), np.asarray(torque)))
    np.testing.assert_allclose(results[0][0], results[1][0], atol=1e-5)
    np.testing.assert_allclose(results[0][1], results[1][1], atol=5e-2)


def test_the_approach_is_the_smaller_of_its_two_pieces() -> None:
    """Exponential near the point, a constant deceleration before, and a line beyond the point."""
    acceleration, rate = 3.0, 12.0
    near = acceleration / rate**2
    distance = np.concatenate([np.linspace(-0.1, 0.5, 1000), [near, 0.0]])
    root = np.sqrt(2 * acceleration * np.maximum(distance - near / 2, near / 2))
    expected = np.where(distance < near, rate * distance, root)
    speed = joint_control.approach_speed(distance, joint_control.approach(acceleration, rate), np)
    np.testing.assert_allclose(speed, expected, rtol=1e-12)


def test_unstated_limits_follow_from_the_others() -> None:
    limits = joint_limits(RANGE, np.full(7, 2.0), np.full(7, 50.0))
    assert limits.acceleration[0] == pytest.approx(8.0)
    assert JointLimits.from_lists(limits.as_lists()).torque_rate == pytest.approx(limits.torque_rate)
