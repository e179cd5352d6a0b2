"""The minima of the metric that a controller follows and changes between, on arms whose minima are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, arm_arrays, lock_joints
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.distance import DistanceWeights
from mimic.metric.kinematics import link_states
from mimic.retargeting import array_goals as goals
from mimic.retargeting.array_goals import Problem, chosen_goal, first_goals, next_goals, random_numbers

WEIGHTS = DistanceWeights(translation=0.5, rotation=1.0, linear_velocity=0.001, angular_velocity=0.01)
ELBOW = np.array([0, 0, 1, 0, 0, 1, 1, 0])  # locks of panda4dof


def distinct(poses):
    """Number of poses that differ by more than what counts as the same."""
    kept: list[np.ndarray] = []
    for pose in np.asarray(poses):
        if all(np.abs(pose - other).max() > goals._SAME for other in kept):
            kept.append(pose)
    return len(kept)


@pytest.fixture(scope="module")
def problem():
    """A 4-joint Panda and an expert in a pose that this arm can take."""
    panda = jax.tree.map(jnp.asarray, arm_arrays(build_arm(ArmConfig())).astype(np.float32))
    expert = link_states(panda, jnp.array([0.6, 0.7, 0.0, -1.3, 0.9, 0.0, 0.0, 0.0]))
    learner = lock_joints(panda, ELBOW)
    return Problem(learner, WEIGHTS, arc_length_correspondence(panda, learner), expert, 0.1)


@pytest.fixture(scope="module")
def advance(problem):
    return jax.jit(
        lambda values, qpos, step: next_goals(problem, values, qpos, random_numbers(jax.random.PRNGKey(0), step))
    )


@pytest.fixture(scope="module")
def after(advance):
    """The goals of an arm that stays in a pose, after some steps without a change of the goal."""
    qpos = jnp.array([-2.5, 0.5, 0.0, -0.5, 0.0, 0.0, 0.0, 0.0])
    values = first_goals(qpos)
    for step in range(8):
        values = advance(values, qpos, step)
    return qpos, values


def test_the_goal_is_a_local_minimum_and_locked_joints_stay(problem, after):
    _, values = after
    slope = jax.jit(jax.grad(problem.distance))(values.goal.qpos)
    np.testing.assert_allclose(slope * problem.arm.is_free, 0.0, atol=2e-2)  # Newton steps on an upper bound
    assert not np.asarray(values.goal.qpos)[ELBOW == 1].any() and not np.asarray(values.others)[:, ELBOW == 1].any()


def test_the_expert_is_found_whatever_the_arm_starts_from(problem, after):
    """The distance of an arm that can take the expert's pose is 0 there, and it is worth most."""
    _, values = after
    goal, best = (float(problem.distance(pose)) for pose in (values.goal.qpos, values.best.qpos))
    assert goal > 0.01 and best < 1e-3 and values.advantage > 0


def test_repeated_minima_make_place_for_others(advance, after):
    """All places have the same minimum: only one of them stays, behind those of new poses if it is farther."""
    qpos, values = after
    repeated = values._replace(others=jnp.tile(values.others[:1], (len(values.others), 1)))
    before = distinct(repeated.others)
    for step in range(20, 24):
        repeated = advance(repeated, qpos, step)
    assert before == 1 and distinct(repeated.others) >= 2


def test_a_goal_changes_by_its_advantage(after):
    _, values = after
    for advantage, changes in ((0.3, True), (0.1, False)):
        chosen = chosen_goal(values._replace(advantage=jnp.asarray(advantage)))
        expected = values.best if changes else values.goal
        np.testing.assert_array_equal(chosen.goal.qpos, expected.qpos)


def test_the_same_minimum_has_no_advantage(advance, after):
    """Once the arm is at the best minimum, nothing is better."""
    _, values = after
    poses = [values.goal.qpos, values.best.qpos]
    best = poses[int(values.advantage > 0)]
    at_goal = advance(first_goals(best), best, 0)
    assert at_goal.advantage < goals.MIN_ADVANTAGE


def test_full_revolutions_are_not_made(problem):
    poses = jnp.array([[6.0, 0, 0, 0, 0, 0, 0, 0.0]])
    for limit, expected in ((2.9, 6.0), (np.pi, 6.0 - 2 * np.pi)):  # a joint with limits has one way only
        arm = problem.arm.replace(joint_range=jnp.tile(jnp.array([-limit, limit]), (MAX_JOINTS, 1)))
        near = goals._without_revolutions(arm, poses, jnp.zeros(MAX_JOINTS))
        np.testing.assert_allclose(near[0, 0], expected, rtol=1e-6)
