"""The closed form of static metrics against automatic differentiation, and the effect of its smoothing."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.embodiment import load_mjcf, panda, planar_arm
from mimic.metric.config import MetricConfig
from mimic.metric.correspondence import arc_length_correspondence, hard_correspondence, overlap_correspondence
from mimic.metric.distance import DistanceWeights, Metric, adaptive_weights, embodiment_distance, rotation_distance
from mimic.metric.kinematics import link_states
from mimic.retargeting.closed_form import SMOOTHING
from mimic.retargeting.pose_objective import pose_objective
from tests.helpers.random_arms import random_arm

DIRECTIONS = DistanceWeights(translation=0.0, rotation=1.7)
BOTH = DistanceWeights(translation=0.6, rotation=1.7)
DEFAULT: Any = MetricConfig().make_weights()


def learners():
    yield panda(locked=(3, 6, 7))
    yield planar_arm([0.3, 0.5, 0.2])
    for seed in range(2):
        yield load_mjcf(random_arm(seed))


def smoothed_angle(direction_a, direction_b):
    return jnp.arccos(np.cos(SMOOTHING.angle) * jnp.dot(direction_a, direction_b)) - SMOOTHING.angle


def smoothed_distance(expert_states, learner_states, matrix, weights, rotation):
    """The embodiment distance with smoothed lengths and angles, pair by pair."""
    turned = smoothed_angle if rotation == "angle" else rotation_distance

    def pair(position_a, direction_a, position_b, direction_b):
        square = jnp.sum((position_a - position_b) ** 2)
        return jnp.sqrt(square + SMOOTHING.length**2) - SMOOTHING.length, turned(direction_a, direction_b)

    expert, learner = ((states.position, states.direction) for states in (expert_states, learner_states))
    translation, rotation = jax.vmap(jax.vmap(pair, (None, None, 0, 0)), (0, 0, None, None))(*expert, *learner)
    return jnp.mean(matrix * (weights.translation * translation + weights.rotation * rotation))


def check_derivatives(learner, matrix, weights, seed=0, rotation: Any = "cosine"):
    """1e-12: double precision of a few hundred operations; Hessians of smoothed lengths reach 1e3."""
    expert, rng = panda(), np.random.default_rng(seed)
    closed = pose_objective(learner, Metric(matrix, weights, rotation))
    states = link_states(expert, rng.uniform(-3, 3, 7))
    target = closed.target(states)

    def distance(qpos):
        return smoothed_distance(states, link_states(learner, qpos), matrix, weights, rotation)

    one, other = rng.uniform(-3, 3, (2, learner.num_joints))
    derivatives = jax.jit(lambda qpos: closed.derivatives(target, tuple(qpos)))
    here, there = derivatives(one), derivatives(other)
    np.testing.assert_allclose(jnp.stack(here.gradient), jax.jit(jax.grad(distance))(one), atol=1e-12)
    hessian = jax.jit(jax.hessian(distance))(one)
    for i, row in enumerate(here.hessian):
        np.testing.assert_allclose(jnp.stack(row[: i + 1]), hessian[i, : i + 1], atol=1e-12)
    np.testing.assert_allclose(here.value - there.value, distance(one) - distance(other), atol=1e-12)
    values = [closed.value(target, link_states(learner, qpos)) for qpos in (one, other)]
    np.testing.assert_allclose(values[0] - values[1], distance(one) - distance(other), atol=1e-12)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("rotation", ["cosine", "angle"])
def test_closed_derivatives_are_those_of_the_smoothed_distance(rotation):
    rng = np.random.default_rng(0)
    for learner in learners():
        shape = panda().num_links, learner.num_links
        matrix = rng.uniform(0, 1, shape)
        check_derivatives(learner, jnp.asarray(matrix * (rng.uniform(size=shape) < 0.5)), BOTH, rotation=rotation)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_arrays_of_weights_and_a_correspondence_known_only_at_run_time():
    expert, learner = panda(), panda(locked=(3, 6, 7))
    rng = np.random.default_rng(1)
    matrix = arc_length_correspondence(expert, learner)
    check_derivatives(learner, matrix, DistanceWeights(rng.uniform(size=(7, 7)), rng.uniform(size=(7, 1))))
    states, qpos = link_states(expert, rng.uniform(-3, 3, 7)), rng.uniform(-3, 3, 4)

    def value_and_gradient(matrix, weights):
        closed = pose_objective(learner, Metric(matrix, weights))
        derivatives = closed.derivatives(closed.target(states), tuple(qpos))
        return derivatives.value, derivatives.gradient

    known = value_and_gradient(matrix, BOTH)
    np.testing.assert_allclose(jnp.stack(jax.jit(value_and_gradient)(matrix, BOTH)[1]), jnp.stack(known[1]), atol=1e-12)


@pytest.mark.parametrize("rotation", ["cosine", "angle"])
def test_a_match_has_zero_gradient_and_finite_curvature(rotation):
    """At the kink of lengths and angles. 1e-4: rounding moves a position by 1e-7 chain lengths; s is 1e-3."""
    arm = panda()
    closed = pose_objective(arm, Metric(arc_length_correspondence(arm, arm), DEFAULT, rotation))
    for qpos in (np.zeros(7), np.linspace(-2, 2, 7)):
        angles = jnp.asarray(qpos, jnp.float32)
        here = closed.derivatives(closed.target(link_states(arm, angles)), tuple(angles))
        assert abs(here.value) <= 1e-8 and here.value.dtype == jnp.float32
        np.testing.assert_allclose(jnp.stack(here.gradient), 0, atol=1e-4)
        assert all(np.all(np.isfinite(jnp.stack(row))) for row in here.hessian)


def test_smoothing_changes_the_distance_by_less_than_its_own_size():
    """Arc length W has entries that sum to n n_hat: the mean length is off by s at most; 1e-5 for float32."""
    expert, learner = panda(), panda(locked=(3, 6, 7))
    matrix = arc_length_correspondence(expert, learner)
    closed = pose_objective(learner, Metric(matrix, DEFAULT))
    qpos = np.random.default_rng(2).uniform(-3, 3, (64, 7)).astype(np.float32)

    @jax.jit
    @jax.vmap
    def values(pose):
        states, own = link_states(expert, pose), link_states(learner, pose[:4])
        derivatives = closed.derivatives(closed.target(states), tuple(pose[:4]))
        return derivatives.value, embodiment_distance(states, own, matrix, DEFAULT)

    smoothed, exact = values(qpos)
    # A diagonal W: one pull for each direction, so the value has no constant.
    apart = exact - smoothed
    assert np.all(apart > -1e-5) and np.all(apart <= DEFAULT.translation * SMOOTHING.length + 1e-5)


OVERLAP = overlap_correspondence(panda(), panda())


@pytest.mark.parametrize(
    ("correspondence", "weights", "rotation", "reduction", "is_closed"),
    [
        (OVERLAP, DEFAULT, "cosine", "mean", True),
        (OVERLAP, DIRECTIONS, "angle", "mean", True),
        (OVERLAP, DIRECTIONS, "cosine", "frobenius", False),
        (OVERLAP, adaptive_weights, "cosine", "mean", False),
        (hard_correspondence, DIRECTIONS, "cosine", "mean", False),
    ],
)
def test_only_weighted_sums_have_the_closed_form(correspondence, weights, rotation, reduction, is_closed):
    arm = panda()
    objective = pose_objective(arm, Metric(correspondence, weights, rotation, reduction))
    states = link_states(arm, jnp.zeros(7))
    assert (objective.target(states) is not states) == is_closed
