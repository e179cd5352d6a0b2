"""The predicted path of a reference is that of the inner loop."""

import numpy as np
import pytest

from mimic.control import joint_control
from mimic.control.joint_control import JointParameters, Reference
from mimic.deploy.path import PathPrediction
from tests.helpers.bundles import parameters

DELAY, HOLD, ROBOTS, TICKS = 20, 70, 30, 20


@pytest.mark.parametrize("mode", ["joint_velocity", "joint_position"])
def test_a_path_is_that_of_the_inner_loop(mode):
    """On random targets, from references in motion; the bound is the one that the margin covers."""
    joints = JointParameters(*(x[:, None] for x in parameters()))
    size, rng = (7, ROBOTS), np.random.default_rng(0)
    reference = Reference(rng.uniform(joints.lower, joints.upper, size), np.zeros(size), np.zeros(size))
    is_position = mode == "joint_position"
    limits = joint_control.reference_limits(joints)
    prediction = PathPrediction(joints, is_position, DELAY, HOLD, ROBOTS)
    target, left = (reference.qpos.copy() if is_position else np.zeros(size)), np.full(ROBOTS, HOLD)
    largest = 0.0
    for _ in range(TICKS):
        action = rng.choice([-1.0, 1.0, 0.3, 0.0], size)

        def new_target(at, action=action):
            return np.array(joint_control.action_target(mode, action, at, joints, np).value)

        prediction.begin(reference, target, left)
        assert prediction.advance(10**6, new_target)
        path, after = exact_path(mode, joints, reference, target, left, new_target, len(prediction.path))
        largest = max(largest, float(np.abs(path - prediction.path).max()))
        reference, target = after
        for period in range(50):
            reference = joint_control.next_reference(mode, reference, target, limits, np)
            assert period < HOLD
        left = rng.integers(0, HOLD, ROBOTS)
    assert 1e-4 < largest < PathPrediction.ERROR
    assert np.abs(path[-1] - path[-2]).max() < 1e-4  # it ends at rest


@pytest.mark.parametrize("steps", [1, 4, 7])
def test_a_path_in_parts_is_the_same(steps):
    """Of several robots, one of them slower, from a little beyond the range, with an odd time left."""
    joints = JointParameters(*(np.tile(x[:, None], 3) for x in parameters()))
    joints.velocity[:, 1] *= 0.5
    reference = Reference(joints.upper + 0.02, 0.5 * joints.velocity, 0 * joints.velocity)
    target, paths = joints.upper - [0.3, 0.2, 0.1], []
    for part in (10**6, steps):
        prediction = PathPrediction(joints, True, DELAY, HOLD, 3)
        prediction.begin(reference, target, np.array([0, 7, HOLD]))
        while not prediction.advance(part, lambda at: at.qpos - 0.2):
            pass
        paths.append(prediction.path.copy())
    np.testing.assert_array_equal(*paths)
    assert len(paths[0]) == prediction.samples and np.ptp(paths[0], axis=0).min() > 0.03


@pytest.mark.parametrize("mode", ["joint_velocity", "joint_position"])
@pytest.mark.parametrize("unknown", ["qpos", "qvel", "qacc", "target", "new target"])
def test_the_path_of_an_unknown_motion_is_unknown(mode, unknown):
    """It ends as NaN, which has no clearance, and the other joints' paths do not change."""
    joints, zero = JointParameters(*(x[:, None] for x in parameters())), np.zeros((7, 1))
    prediction = PathPrediction(joints, mode == "joint_position", DELAY, HOLD)
    given = {name: zero + 0.1 for name in ("qpos", "qvel", "qacc", "target", "new target")}
    paths = []
    for value in (0.1, np.nan):
        given[unknown] = np.where(np.arange(7)[:, None] == 2, value, 0.1)
        prediction.begin(Reference(given["qpos"], given["qvel"], given["qacc"]), given["target"], np.array([HOLD]))
        assert prediction.advance(10**6, lambda at: given["new target"])
        paths.append(prediction.path[:, :, 0].copy())
    known, path = paths
    assert np.isfinite(known).all() and np.isnan(path[1:, 2]).all()
    np.testing.assert_array_equal(np.delete(path, 2, axis=1), np.delete(known, 2, axis=1))


def exact_path(mode, joints, reference, target, left, new_target, samples):
    """The angles after each 10 ms from the delay on, and the reference and target when the new one begins to act."""
    zero, path, limits = np.zeros_like(target), [], joint_control.reference_limits(joints)
    for period in range(DELAY):
        held = joint_control.next_reference(mode, reference, target, limits, np)
        braking = joint_control.next_reference("joint_velocity", reference, zero, limits, np)
        reference = Reference(*(np.where(left > period, x, y) for x, y in zip(held, braking, strict=True)))
    after = reference, new_target(reference)
    path.append(reference.qpos)
    for period in range(10 * (samples - 1)):
        is_held = period < HOLD
        reference = joint_control.next_reference(
            mode if is_held else "joint_velocity", reference, after[1] if is_held else zero, limits, np
        )
        if (period + 1) % 10 == 0:
            path.append(reference.qpos)
    return np.array(path), after
