"""The closed form of the static rotational measure against automatic differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_arms import random_arm

from mimic.correspondence import hard_correspondence, overlap_correspondence
from mimic.distance import DistanceWeights, adaptive_weights, embodiment_distance
from mimic.embodiment import load_mjcf, panda, planar_arm
from mimic.kinematics import link_states
from mimic.objective import pose_objective

DIRECTIONS = DistanceWeights(translation=0.0, rotation=1.7)


def learners():
    yield panda(locked=(3, 6, 7))
    yield planar_arm([0.3, 0.5, 0.2])
    for seed in range(2):
        yield load_mjcf(random_arm(seed))


@pytest.mark.usefixtures("x64")
def test_closed_derivatives_are_those_of_the_distance():
    """1e-12: double precision of a few hundred operations."""
    expert = panda()
    rng = np.random.default_rng(0)
    for learner in learners():
        matrix = jnp.asarray(rng.uniform(-0.5, 1, (expert.num_links, learner.num_links)))  # any sign will do
        closed = pose_objective(learner, matrix, DIRECTIONS, "cosine", "mean")
        states = link_states(expert, rng.uniform(-3, 3, 7))
        target = closed.target(states)

        def distance(qpos, states=states, learner=learner, matrix=matrix):
            return embodiment_distance(states, link_states(learner, qpos), matrix, DIRECTIONS)

        one, other = rng.uniform(-3, 3, (2, learner.num_joints))
        derivatives = jax.jit(lambda qpos, closed=closed, target=target: closed.derivatives(target, tuple(qpos)))
        found = derivatives(one)
        np.testing.assert_allclose(jnp.stack(found.gradient), jax.jit(jax.grad(distance))(one), atol=1e-12)
        hessian = jax.jit(jax.hessian(distance))(one)
        for i, row in enumerate(found.hessian):
            np.testing.assert_allclose(jnp.stack(row[: i + 1]), hessian[i, : i + 1], atol=1e-12)
        there = derivatives(other)
        np.testing.assert_allclose(found.value - there.value, distance(one) - distance(other), atol=1e-12)
        values = [closed.value(target, link_states(learner, qpos)) for qpos in (one, other)]
        np.testing.assert_allclose(values[0] - values[1], distance(one) - distance(other), atol=1e-12)


@pytest.mark.parametrize(
    ("correspondence", "weights", "rotation", "reduction", "is_closed"),
    [
        (overlap_correspondence(panda(), panda()), DIRECTIONS, "cosine", "mean", True),
        (overlap_correspondence(panda(), panda()), DIRECTIONS, "angle", "mean", False),
        (overlap_correspondence(panda(), panda()), DIRECTIONS, "cosine", "frobenius", False),
        (overlap_correspondence(panda(), panda()), DistanceWeights(0.1, 1.0), "cosine", "mean", False),
        (overlap_correspondence(panda(), panda()), adaptive_weights, "cosine", "mean", False),
        (hard_correspondence, DIRECTIONS, "cosine", "mean", False),
    ],
)
def test_the_closed_form_is_for_its_measure_alone(correspondence, weights, rotation, reduction, is_closed):
    arm = panda()
    objective = pose_objective(arm, correspondence, weights, rotation, reduction)
    states = link_states(arm, jnp.zeros(7))
    assert (objective.target(states) is not states) == is_closed
