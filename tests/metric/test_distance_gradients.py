import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.embodiment import panda
from mimic.metric.correspondence import overlap_correspondence
from mimic.metric.distance import PAPER_WEIGHTS, embodiment_distance
from mimic.metric.kinematics import LinkStates, link_states
from tests.helpers.metric_cases import (
    ALL_WEIGHTS,
    CORRESPONDENCES,
    EXPERT,
    LEARNER,
    MEASURES,
    REDUCTIONS,
    WEIGHTS,
    states,
)


def distances_of(combinations):
    """Distance by (correspondence, weights, measure, reduction), a function of states [4, n, 3] of both arms."""

    def distances(a, b):
        pair = LinkStates(*a), LinkStates(*b)
        return jnp.stack(
            [embodiment_distance(*pair, c, w, rotation=m, reduction=r) for c, w, m, r in combinations],
        )

    return distances


def generic_states(dtype):
    of_arms = (states(arm, seed, dtype) for seed, arm in enumerate((EXPERT, LEARNER)))
    return tuple(jnp.stack(jax.tree.leaves(dataclasses.replace(x, hand=None))) for x in of_arms)


def singular_states(dtype):
    """Pairs at which parts of the distance have kinks; the learner's links are the expert's first two."""
    a = generic_states(dtype)[0]
    b = a[:, :2]
    moving, still, turned = jnp.asarray([[1, 1, 0, 0], [0, 1, 0, 0], [1, -1, 1, 1]])[:, :, None, None]
    tiny = b.at[0].add(1e-20).at[2].add(1e-23)  # squares underflow in float32
    pairs = [(a, b), (a * moving, b * moving), (a, b * turned), (a, b * moving), (a * still, b * still)]
    return tuple(jnp.stack(side).astype(dtype) for side in zip(*[*pairs, (a, tiny)], strict=True))


def central_differences(function, point, step):
    """d function / d point, [outputs, *point.shape]."""
    shifts = step * jnp.eye(point.size).reshape(-1, *point.shape)
    ahead, behind = jnp.split(jax.vmap(function)(point + jnp.concatenate([shifts, -shifts])), 2)
    return ((ahead - behind) / (2 * step)).T.reshape(-1, *point.shape)


# Every correspondence, weight, measure and reduction once, and all correspondences with all weights.
COVER = [
    ("overlap", "constant", "cosine", "mean"),
    ("hard", "adaptive", "angle", "mean"),
    ("soft", "matrix", "angle", "frobenius"),
    ("matrix", "adaptive", "cosine", "frobenius"),
]
ALL = [
    (c, w, MEASURES[(i + j) % 2], REDUCTIONS[(i + j // 2 + i // 2) % 2])
    for i, c in enumerate(CORRESPONDENCES)
    for j, w in enumerate(WEIGHTS)
]
EACH = pytest.mark.parametrize("names", [COVER, pytest.param(ALL, marks=pytest.mark.slow)], ids=["cover", "all"])


def metrics(names):
    return [(CORRESPONDENCES[c], WEIGHTS[w], *options) for c, w, *options in names]


@EACH
def test_gradients_equal_finite_differences(x64, names):
    function = distances_of(metrics(names))
    a, b = generic_states(np.float64)
    of_both = jax.jit(lambda point: function(point[: a.size].reshape(a.shape), point[a.size :].reshape(b.shape)))
    point = jnp.concatenate([a.ravel(), b.ravel()])
    gradient = jax.jit(jax.jacrev(of_both))(point)
    step = 1e-6  # balances the error of the difference, step^2, against that of rounding, 1e-16 / step
    expected = central_differences(of_both, point, step)
    np.testing.assert_allclose(gradient, expected, rtol=1e-6, atol=1e-8)  # 1e-10, times derivatives of up to 100
    assert np.all(abs(gradient[:, a.size :]).max(axis=1) > 1e-3)  # and it is not 0


@EACH
def test_gradients_are_finite_at_the_kinks(names):
    matching = np.array([[2, 0], [0, 2], [0, 0]])  # the links that match in the first two pairs of states
    at_a_match = [(matching, WEIGHTS["constant"], *options) for options in zip(MEASURES, REDUCTIONS, strict=True)]
    function = distances_of([*at_a_match, *metrics(names)])
    gradient = jax.vmap(jax.jacrev(function, argnums=1))(*singular_states(np.float32))
    assert gradient.dtype == np.float32
    assert np.all(np.isfinite(gradient))
    assert abs(gradient).max() < 100  # a norm's slope is 1, weights are up to 3
    assert not gradient[:2, : len(at_a_match)].any()


def test_gradients_of_the_joint_motion_equal_finite_differences(x64):
    overlap = overlap_correspondence(EXPERT, LEARNER)

    @jax.jit
    def distances(motion):
        (qpos, qvel), (qpos_hat, qvel_hat) = motion[:6].reshape(2, 3), motion[6:].reshape(2, 2)
        pair = link_states(EXPERT, qpos, qvel), link_states(LEARNER, qpos_hat, qvel_hat)
        return embodiment_distance(*pair, overlap, ALL_WEIGHTS)[None]

    motion = jnp.asarray(np.random.default_rng(7).uniform(-2, 2, 10))
    step = 1e-6  # as above
    expected = central_differences(distances, motion, step)
    np.testing.assert_allclose(jax.jacrev(distances)(motion), expected, rtol=1e-6, atol=1e-8)
    assert abs(expected).max() > 0.1


@pytest.mark.slow
def test_panda_gradients_under_jit_and_vmap():
    arm = panda(locked=(3, 6, 7))
    overlap = overlap_correspondence(arm, arm)

    def distance(motion, expert_motion):
        states = link_states(arm, *expert_motion), link_states(arm, *motion)
        return embodiment_distance(*states, overlap, PAPER_WEIGHTS)

    gradient = jax.jit(jax.vmap(jax.grad(distance)))
    motions = jnp.asarray(np.random.default_rng(0).uniform(-2, 2, (3, 2, 4)), jnp.float32).at[0].set(0)
    at_a_match = gradient(motions, motions)
    assert np.all(np.isfinite(at_a_match)) and not at_a_match[0].any()
    alone = jax.jit(jax.grad(distance))(motions[1] + 0.1, motions[1])
    np.testing.assert_allclose(gradient(motions + 0.1, motions)[1], alone, rtol=1e-4, atol=1e-5)  # float32, fused
    assert abs(alone).max() > 0.01
