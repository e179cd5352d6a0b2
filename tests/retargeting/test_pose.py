"""Retargeted poses are global minima within limits, and retargeted motions do not jump."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from mimic.arms.embodiment import panda, planar_arm
from mimic.metric.config import MetricConfig
from mimic.metric.correspondence import arc_length_correspondence, hard_correspondence, overlap_correspondence
from mimic.metric.distance import DistanceWeights, adaptive_weights, embodiment_distance
from mimic.metric.kinematics import link_states
from mimic.retargeting.closed_form import SMOOTHING
from mimic.retargeting.pose import checked_poses, imitate_pose
from mimic.retargeting.trajectory import imitate_trajectory
from tests.helpers.metric_cases import planar_optimum

DIRECTIONS = DistanceWeights(translation=0.0, rotation=1.0)
DEFAULT = MetricConfig()
METRICS = {
    "directions": (overlap_correspondence, DIRECTIONS),
    "default": (DEFAULT.make_correspondence, DEFAULT.make_weights()),
}
PAIRS = {
    "planar 7->4": (planar_arm([1 / 7] * 7), planar_arm([1 / 4] * 4)),
    "planar 4->7": (planar_arm([1 / 4] * 4), planar_arm([1 / 7] * 7)),
    "planar 3->2": (planar_arm([1 / 3] * 3), planar_arm([0.5, 0.5])),
    "panda 7->4": (panda(), panda(locked=(3, 6, 7))),
}


def poses(arm, count, seed=0):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, arm.num_joints)).astype(np.float32)


@pytest.mark.slow_for("planar 4->7")
@pytest.mark.parametrize("name", ["planar 7->4", "planar 4->7"])
def test_planar_arms_reach_the_closed_form(name):
    expert, learner = PAIRS[name]
    qpos = poses(expert, 64)
    solution = imitate_pose(expert, learner, qpos, overlap_correspondence(expert, learner), DIRECTIONS)
    np.testing.assert_allclose(solution.distance, planar_optimum(expert, learner, qpos), atol=2e-6)  # float32
    assert np.all(solution.converged) and np.all(np.abs(solution.qpos) <= np.pi + 1e-6)


@pytest.mark.slow_for("default-1e-06")
@pytest.mark.parametrize(("metric", "tolerance"), [("directions", 1e-9), ("default", 1e-6)])
def test_an_equal_arm_finds_the_pose_itself(metric, tolerance):
    """Distances of directions are quadratic in the error, of positions linear: float32 rounds it to 1e-7."""
    arm, (correspond, weights) = panda(locked=(3, 6, 7)), METRICS[metric]
    solution = imitate_pose(arm, arm, poses(arm, 32), correspond(arm, arm), weights)
    assert np.all(solution.distance < tolerance) and np.all(solution.converged)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "weights"), [("panda 7->4", (0.5, 1.0)), ("planar 7->4", (2.0, 1.0))])
def test_no_descent_of_the_distance_itself_gets_lower(name, weights, dtype):
    """By SciPy's simplex, without derivatives, from the minimum of the smoothed distance.

    The distance there is above its own minimum by a_tr s at most, where a link matches exactly.
    """
    expert, learner = PAIRS[name]
    matrix, alpha = arc_length_correspondence(expert, learner), DistanceWeights(*weights)
    qpos = poses(expert, 64).astype(dtype)
    solution = imitate_pose(expert, learner, qpos, matrix, alpha)
    assert solution.distance.dtype == dtype
    assert np.mean(solution.converged) > 0.9  # 0.94 to 1 of 256 poses
    distance = jax.jit(
        lambda pose, q: embodiment_distance(link_states(expert, pose), link_states(learner, q), matrix, alpha)
    )
    for pose, start, left, _ in zip(qpos, solution.qpos, solution.distance, range(6), strict=False):
        nearby = minimize(lambda q, pose=pose: float(distance(pose, q.astype(dtype))), start, method="Nelder-Mead")
        assert left <= nearby.fun + weights[0] * SMOOTHING.length + 1e-6


@pytest.mark.slow
def test_the_minimum_is_global():
    """Against long descents from 512 random initial guesses: within 1e-3 for at least 99.5 % of the poses."""
    expert, learner = PAIRS["panda 7->4"]
    qpos, correspondence = poses(expert, 400, seed=1), overlap_correspondence(expert, learner)
    solution = imitate_pose(expert, learner, qpos, correspondence, DIRECTIONS)
    options = {"starts": 512, "iterations": 60, "key": jax.random.key(1)}
    best = jax.lax.map(lambda pose: imitate_pose(expert, learner, pose, correspondence, DIRECTIONS, **options), qpos)
    assert np.mean(solution.distance <= best.distance * 1.001 + 1e-6) >= 0.995


def test_joint_limits_are_kept():
    expert, learner = panda(), panda(locked=(3, 6, 7), limits="hardware", links="merged")
    correspondence = overlap_correspondence(expert, learner)
    solution = imitate_pose(expert, learner, poses(expert, 32), correspondence, DIRECTIONS)
    lower, upper = learner.joint_range.T
    assert np.all((solution.qpos >= lower - 1e-6) & (solution.qpos <= upper + 1e-6))
    held = np.isclose(solution.qpos, lower, atol=1e-6) | np.isclose(solution.qpos, upper, atol=1e-6)
    assert held.any() and np.mean(solution.converged) > 0.95


@pytest.mark.slow
def test_distances_belong_to_the_poses_and_no_nearby_pose_is_better():
    expert, learner = PAIRS["panda 7->4"]
    qpos = poses(expert, 8)
    for weights, correspondence, tolerance in (
        # 1e-4: the nearest link, and with it the slope, changes within the 1e-2 rad (found here: 5e-5 lower).
        (adaptive_weights, hard_correspondence, 1e-4),
        # 1e-5: lengths that are not smoothed have a kink, at which Newton steps end before the minimum (2e-6 lower).
        (DistanceWeights(1.0, 1.0), hard_correspondence, 1e-5),
        (DEFAULT.make_weights(), DEFAULT.make_correspondence(expert, learner), 1e-6),
    ):
        solution = imitate_pose(expert, learner, qpos, correspondence, weights)

        def distance(qpos, learner_qpos, weights=weights, correspondence=correspondence):
            states = link_states(expert, qpos), link_states(learner, learner_qpos)
            return embodiment_distance(*states, correspondence, weights)

        batched = jax.vmap(distance)
        np.testing.assert_allclose(batched(qpos, solution.qpos), solution.distance, atol=1e-6)
        for seed in range(10):
            near = solution.qpos + 1e-2 * np.random.default_rng(seed).normal(size=solution.qpos.shape)
            assert np.all(batched(qpos, near) > solution.distance - tolerance)


@pytest.mark.slow
def test_dropped_initial_guesses_are_not_missed():
    expert, learner = PAIRS["planar 3->2"]
    arguments = expert, learner, poses(expert, 64), overlap_correspondence(expert, learner), DIRECTIONS
    few, every = (imitate_pose(*arguments, kept=kept) for kept in (2, None))
    assert np.all(every.converged) and np.all(few.converged)
    np.testing.assert_allclose(few.distance, every.distance, atol=1e-5)


def test_shapes_and_warm_starts():
    expert, learner = PAIRS["planar 3->2"]
    correspondence = overlap_correspondence(expert, learner)
    qpos = poses(expert, 6)
    one = imitate_pose(expert, learner, qpos[0], correspondence, DIRECTIONS)
    many = imitate_pose(expert, learner, qpos.reshape(2, 3, 3), correspondence, DIRECTIONS)
    assert one.qpos.shape == (2,) and many.qpos.shape == (2, 3, 2) and many.distance.shape == (2, 3)
    np.testing.assert_allclose(one.distance, many.distance[0, 0], atol=1e-6)
    warm = imitate_pose(
        expert, learner, qpos, correspondence, DIRECTIONS, warm_start=many.qpos.reshape(6, 2), iterations=2
    )
    np.testing.assert_allclose(warm.distance, many.distance.reshape(6), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("metric", "limits"),
    [(MetricConfig(translation=0.0, correspondence="overlap"), "hardware"), (DEFAULT, "none")],
    ids=["directions", "default"],
)
def test_trajectories_do_not_jump(metric, limits):
    expert, learner = panda(limits=limits), panda(locked=(3, 6, 7), limits=limits)
    times = np.linspace(0, 1, 51)[:, None]
    lower, upper = expert.joint_range.T
    goal = np.random.default_rng(3).uniform(lower, upper)
    qpos = (expert.home + (goal - expert.home) * (3 * times**2 - 2 * times**3)).astype(np.float32)
    correspondence, weights = metric.make_correspondence(expert, learner), metric.make_weights()
    motion = imitate_trajectory(expert, learner, qpos, correspondence, weights, largest_jump=0.2)
    assert np.abs(np.diff(motion.qpos, axis=0)).max() <= 0.2 + 1e-6
    best = imitate_pose(expert, learner, qpos, correspondence, weights)
    # A best pose may be above the minimum by the smoothing.
    assert np.all(motion.distance > best.distance - 1e-5 - metric.translation * SMOOTHING.length)
    assert motion.distance.mean() < 1.3 * best.distance.mean()  # six such motions: at most 1.24 times
    lower, upper = learner.joint_range.T
    if limits == "hardware":
        assert np.all((motion.qpos >= lower - 1e-6) & (motion.qpos <= upper + 1e-6))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("qpos", "options", "message"),
    [
        (np.zeros(6), {}, r"qpos: expected shape \[..., 7\] for planar7, got \(6,\)"),
        (np.full(7, np.nan), {}, "qpos: expected finite angles of at most 10,000 rad, got nan"),
        (np.array([0, 0, -1e30, 0, 0, 0, 0]), {}, "qpos: expected finite angles of at most 10,000 rad, got -1e\\+30"),
        (np.zeros((0, 7)), {}, "qpos: expected one pose or more"),
        (np.zeros(7), {"starts": -1}, "starts: expected a whole number of at least 0, got -1"),
        (np.zeros(7), {"starts": 2.5}, "starts: expected a whole number of at least 0, got 2.5"),
        (["a"] * 7, {}, "qpos: expected real numbers, got <U1"),
        (np.zeros(7, complex), {}, "qpos: expected real numbers, got complex128"),
        ([[0] * 7, [0] * 6], {}, "qpos: expected rows of one length"),
        (np.zeros(7), {"hand": "exact", "base": "left"}, "base: expected real numbers"),
        (np.zeros(7), {"hand": "near"}, "hand: expected one of free, exact, got 'near'"),
        (np.zeros(7), {"kept": 0}, "kept: expected a whole number of at least 1, got 0"),
        (np.zeros(7), {"warm_start": np.zeros(7)}, r"warm_start: expected shape \[..., 4\]"),
    ],
)
def test_bad_input_is_rejected(qpos, options, message):
    expert, learner = PAIRS["planar 7->4"]
    with pytest.raises(ValueError, match=message):
        imitate_pose(expert, learner, qpos, jnp.ones((7, 4)), DIRECTIONS, **options)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("jump", [0.0, np.nan, "fast", [0.1] * 7])
def test_a_jump_that_is_no_angle_is_rejected(jump):
    expert, learner = PAIRS["planar 7->4"]
    with pytest.raises(ValueError, match="largest_jump: expected"):
        imitate_trajectory(expert, learner, np.zeros((3, 7)), jnp.ones((7, 4)), DIRECTIONS, largest_jump=jump)


def test_half_precision_is_widened():
    assert checked_poses(PAIRS["planar 7->4"][0], np.zeros(7, np.float16)).dtype == np.float32
