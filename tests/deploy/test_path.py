"""Paths of references: as the inner loop moves under a target, and then within the limits until every joint rests."""

import numpy as np
import pytest

from mimic.control.joint_control import PERIOD, JointParameters, Reference, next_reference, reference_limits
from mimic.deploy.path import STEP, PathGenerator, extended
from tests.helpers.bundles import parameters

HOLD, ROBOTS = 50, 30


def random_paths(mode):
    """Paths under random targets, from references in motion, and the references after each period under the target."""
    joints, rng = JointParameters(*(x[:, None] for x in parameters())), np.random.default_rng(0)
    size, limits = (7, ROBOTS), reference_limits(joints)
    reference = Reference(rng.uniform(joints.lower, joints.upper, size), np.zeros(size), np.zeros(size))
    generator = PathGenerator(mode, joints, HOLD)
    for _ in range(20):
        action = rng.choice([-1.0, 1.0, 0.3, 0.0], size)
        target = reference.qpos + action * joints.reach if mode == "joint_position" else action * joints.velocity
        path, references = generator.target_path(reference, target), []
        for _ in range(HOLD):
            reference = next_reference(mode, reference, target, limits, np)
            references.append(reference)
        yield generator, joints, path, references


@pytest.mark.parametrize("mode", ["joint_velocity", "joint_position"])
def test_a_path_is_that_of_the_inner_loop_and_ends_at_rest_within_the_limits(mode):
    fastest, step = 0.0, STEP * PERIOD
    for generator, joints, path, references in random_paths(mode):
        held = np.stack(references[STEP - 1 :: STEP], axis=1)
        np.testing.assert_array_equal(path[:, : generator.hold_steps], held)
        qpos, qvel, qacc = path
        tolerance = 1 + 1e-9
        assert np.all(np.abs(qvel) <= joints.velocity * tolerance)
        assert np.all(np.abs(qacc) <= joints.acceleration * tolerance)
        jerk = np.abs(np.diff(qacc[:-1], axis=0)) / step
        assert np.all(jerk <= joints.jerk * tolerance)
        assert np.all(qpos <= joints.upper + 2e-3) and np.all(qpos >= joints.lower - 2e-3)  # of the larger steps
        assert np.all(path[1:, -1] == 0) and np.abs(qvel[-2]).max() < 1e-3
        np.testing.assert_allclose(np.diff(qpos[generator.hold_steps :], axis=0)[:-1],
                                   step * qvel[generator.hold_steps + 1 : -1], atol=1e-12)  # fmt: skip
        fastest = max(fastest, float(np.abs(qvel).max()))
        assert len(qpos) <= generator.hold_steps + generator.brake_steps
    assert fastest > 2  # rad/s


def test_an_arm_at_rest_has_a_short_path():
    joints = JointParameters(*(x[:, None] for x in parameters()))
    zero = np.zeros((7, 1))
    middle = Reference((joints.lower + joints.upper) / 2, zero, zero)
    assert PathGenerator("joint_velocity", joints, HOLD).target_path(middle, zero).shape[1] == HOLD // STEP + 1


def test_slower_steps_brake_as_the_inner_loop_does():
    """The pose of a stop differs from that of steps of 1 ms by less than the margin covers."""
    joints = JointParameters(*(x[:, None] for x in parameters()))
    moving = Reference((joints.lower + joints.upper) / 2, joints.velocity.copy(), np.zeros((7, 1)))
    exact, zero = moving, np.zeros((7, 1))
    generator, limits = PathGenerator("joint_velocity", joints, HOLD), reference_limits(joints)
    for _ in range(generator.brake_steps * STEP):
        exact = next_reference("joint_velocity", exact, zero, limits, np)
    assert np.abs(exact.qvel).max() < 1e-4
    np.testing.assert_allclose(generator.braking_path(moving)[0, -1], exact.qpos, atol=0.02)


def test_an_extended_path_stays_where_it_ends():
    path = np.arange(3 * 5 * 2.0).reshape(3, 5, 2, 1)
    longer = extended(path, 7)
    np.testing.assert_array_equal(longer[:, :5], path)
    np.testing.assert_array_equal(longer[:, 5:], path[:, [4, 4]])


@pytest.mark.parametrize("unknown", ["qpos", "qvel", "qacc", "target"])
def test_the_path_of_an_unknown_motion_is_unknown(unknown):
    """It has NaN, which has no clearance, and the other joints' paths do not change."""
    joints = JointParameters(*(x[:, None] for x in parameters()))
    generator, paths = PathGenerator("joint_velocity", joints, HOLD), []
    for value in (0.1, np.nan):
        given = {name: np.full((7, 1), 0.1) for name in ("qpos", "qvel", "qacc", "target")}
        given[unknown][2] = value
        paths.append(generator.target_path(Reference(given["qpos"], given["qvel"], given["qacc"]), given["target"])[0])
    known, path = extended(paths[0][None], paths[1].shape[0])[0], paths[1]
    assert np.isfinite(known).all() and np.isnan(path[:, 2]).all()
    np.testing.assert_allclose(np.delete(path, 2, axis=1), np.delete(known, 2, axis=1), atol=2e-6)  # of rest
