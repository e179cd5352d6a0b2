"""The nearest pose of any arm by Newton steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, arm_arrays, lock_joints
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.hand import HandWeights
from mimic.metric.kinematics import link_states
from mimic.retargeting.array_nearest import nearest_pose, pose_quadratic

WEIGHTS = DistanceWeights(1.0, 1.0, 0.0, 0.0)
LOCKED = np.array([0, 0, 1, 0, 0, 1, 1, 0])


@pytest.fixture(scope="module")
def panda():
    return arm_arrays(build_arm(ArmConfig()))


def motion(seed):
    qpos, qvel = np.random.default_rng(seed).uniform(-1.5, 1.5, (2, MAX_JOINTS))
    qpos[7:], qvel[7:] = 0, 0
    return jnp.asarray(qpos), jnp.asarray(qvel)


def test_the_gradient_is_that_of_the_metric(x64, panda):
    learner, matrix = lock_joints(panda, LOCKED), arc_length_correspondence(panda, panda)
    expert, qpos = link_states(panda, *motion(0)), motion(1)[0] * learner.is_free
    metric = Metric(matrix, WEIGHTS, hand_weights=HandWeights(0.3))
    expected = jax.jit(jax.grad(lambda q: metric(expert, link_states(learner, q))))(qpos) * learner.is_free
    near = jax.jit(lambda q: pose_quadratic(learner, WEIGHTS, matrix, expert, q, 0.3))(qpos)
    np.testing.assert_allclose(near.gradient, expected, rtol=0, atol=1e-13)  # rounding of a few hundred operations
    np.testing.assert_allclose(near.hessian, near.hessian.T, rtol=0, atol=1e-15)
    assert np.linalg.eigvalsh(near.hessian).min() > 0


def test_steps_lead_to_an_equal_arm_and_its_velocity(x64, panda):
    """The damping of the Hessian, 1e-3 of its mean, slows the steps and the velocity of joints that move little."""
    qpos, qvel = motion(2)
    expert, matrix = link_states(panda, qpos, qvel), arc_length_correspondence(panda, panda)
    start = qpos + 0.2 * motion(3)[0]
    found, velocity, _ = nearest_pose(panda, WEIGHTS, matrix, expert, start, 60)
    np.testing.assert_allclose(found[:6], qpos[:6], rtol=0, atol=1e-5)
    np.testing.assert_allclose(velocity[:6], qvel[:6], rtol=0, atol=0.05)
    np.testing.assert_allclose(found[6], qpos[6], rtol=0, atol=0.1)  # it moves only the last link, by a few cm


def test_poses_stay_within_ranges(x64, panda):
    qpos, qvel = motion(5)
    ranges = np.where(np.arange(MAX_JOINTS)[:, None] == 1, [[-0.1, 0.2]], panda.joint_range)
    learner = panda.replace(joint_range=ranges)
    lower, upper = learner.angle_limits
    assert lower[1] == -0.1 and upper[1] == 0.2 and np.isinf(lower[0])  # the others rotate by a full revolution
    expert, matrix = link_states(panda, qpos, qvel), arc_length_correspondence(panda, panda)
    found, *_ = nearest_pose(learner, WEIGHTS, matrix, expert, jnp.zeros(MAX_JOINTS), 10)
    assert float(found[1]) in (-0.1, 0.2)
