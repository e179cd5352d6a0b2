"""A second call with equal arms, metric and shapes compiles nothing; calls inside transforms of the user work."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.embodiment import planar_arm
from mimic.metric.config import MetricConfig
from mimic.metric.correspondence import hard_correspondence
from mimic.metric.distance import DistanceWeights
from mimic.retargeting.kinematic_bound import kinematic_bound
from mimic.retargeting.pose import imitate_pose
from mimic.retargeting.trajectory import imitate_trajectory
from tests.helpers.compilations import count_compilations


def arms():
    """New objects at each call, equal by value."""
    return planar_arm([0.4, 0.35, 0.25]), planar_arm([0.6, 0.4])


def qpos(seed, count=4):
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)).astype(np.float32)


FEW: dict[str, Any] = {"starts": 2, "iterations": 4}


def pose(q, metric, **options):
    return imitate_pose(*arms(), q, **metric, **FEW, **options)


DEFAULT, MOTION = MetricConfig(), {"starts": 1, "iterations": 2}
FUNCTIONS = {
    "imitate_pose": (pose, DEFAULT),
    "key": (lambda q, metric: pose(q, metric, key=jax.random.key(int(1e4 * abs(q[0, 0])))), DEFAULT),
    "adaptive": (pose, MetricConfig(adaptive=True)),  # functions of the metric that are equal by value
    "imitate_trajectory": (lambda q, metric: imitate_trajectory(*arms(), q, **metric, starts=1), DEFAULT),
    "kinematic_bound": (lambda q, metric: kinematic_bound(*arms(), q, 0 * q, **metric, **MOTION), DEFAULT),
}


@pytest.mark.slow_for("key", "imitate_trajectory", "kinematic_bound")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_second_call_compiles_nothing(name):
    call, metric = FUNCTIONS[name]
    first = call(qpos(0), metric.build(*arms()).arguments)
    call(qpos(0), metric.build(*arms()).arguments)  # JAX's own small functions of the results
    with count_compilations() as events:
        second = call(qpos(0), metric.build(*arms()).arguments)
        other = call(qpos(1), metric.build(*arms()).arguments)
    assert events == []
    jax.tree.map(np.testing.assert_array_equal, first, second)
    assert any(np.any(a != b) for a, b in zip(jax.tree.leaves(second), jax.tree.leaves(other), strict=True))


@pytest.mark.slow
def test_other_values_are_not_mixed_up():
    """Arms, weights and correspondences of the same shapes give their own results."""
    expert, learner = arms()
    other = planar_arm([0.3, 0.7])
    weights = DistanceWeights(1.0, 1.0)
    base = imitate_pose(expert, learner, qpos(0), hard_correspondence, weights, **FEW).distance
    for arguments in (
        (expert, other, qpos(0), hard_correspondence, weights),
        (expert, learner, qpos(0), hard_correspondence, DistanceWeights(2.0, 1.0)),
        (expert, learner, qpos(0), jnp.ones((3, 2)), weights),
    ):
        assert np.all(np.abs(imitate_pose(*arguments, **FEW).distance - base) > 1e-4)


@pytest.mark.slow
def test_calls_inside_transforms():
    """jit, vmap and grad of a caller give what plain calls give; grad equals finite differences."""
    metric, poses = MetricConfig().build(*arms()).arguments, qpos(2)

    def distance(pose):
        return imitate_pose(*arms(), pose, **metric, **FEW).distance

    plain = np.array([distance(pose) for pose in poses])
    for transformed in (jax.vmap(distance), jax.jit(jax.vmap(distance)), jax.vmap(jax.jit(distance))):
        np.testing.assert_allclose(transformed(poses), plain, atol=1e-6)
    gradient = np.asarray(jax.grad(distance)(poses[0]))
    step = 1e-2 * np.eye(3, dtype=np.float32)
    numeric = [(distance(poses[0] + d) - distance(poses[0] - d)) / 2e-2 for d in step]
    np.testing.assert_allclose(gradient, numeric, atol=2e-3)  # float32
    with count_compilations() as events:
        jax.vmap(distance)(qpos(3))
    assert events == []


def test_traced_arguments_belong_to_the_trace():
    """Weights that the caller's jit traces work, and nothing of the trace is kept."""
    metric = MetricConfig().build(*arms())

    @jax.jit
    def distances(weights, key):
        options = {**metric.arguments, "weights": DistanceWeights(weights[0], weights[1])}
        return imitate_pose(*arms(), qpos(0), key=key, **options, **FEW).distance

    expected = imitate_pose(*arms(), qpos(0), **metric.arguments, key=jax.random.key(1), **FEW).distance
    np.testing.assert_allclose(distances(jnp.array([1.0, 1.0]), jax.random.key(1)), expected, atol=1e-6)
    with jax.checking_leaks():
        distances(jnp.array([2.0, 1.0]), jax.random.key(1))
