import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from mimic.metric.distance import embodiment_distance
from mimic.metric.kinematics import LinkStates
from tests.helpers.metric_cases import (
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


# Every correspondence, weight, measure and reduction once.
COVER = [
    ("overlap", "constant", "cosine", "mean"),
    ("hard", "adaptive", "angle", "mean"),
    ("soft", "matrix", "angle", "frobenius"),
    ("matrix", "adaptive", "cosine", "frobenius"),
]
METRICS = [(CORRESPONDENCES[c], WEIGHTS[w], *options) for c, w, *options in COVER]


def test_gradients_equal_finite_differences(x64):
    function = distances_of(METRICS)
    a, b = generic_states(np.float64)
    of_both = jax.jit(lambda point: function(point[: a.size].reshape(a.shape), point[a.size :].reshape(b.shape)))
    point = jnp.concatenate([a.ravel(), b.ravel()])
    gradient = jax.jit(jax.jacrev(of_both))(point)
    step = 1e-6  # balances the error of the difference, step^2, against that of rounding, 1e-16 / step
    expected = central_differences(of_both, point, step)
    np.testing.assert_allclose(gradient, expected, rtol=1e-6, atol=1e-8)  # 1e-10, times derivatives of up to 100
    assert np.all(abs(gradient[:, a.size :]).max(axis=1) > 1e-3)  # and it is not 0


def test_gradients_are_finite_at_the_kinks():
    matching = np.array([[2, 0], [0, 2], [0, 0]])  # the links that match in the first two pairs of states
    at_a_match = [(matching, WEIGHTS["constant"], *options) for options in zip(MEASURES, REDUCTIONS, strict=True)]
    function = distances_of([*at_a_match, *METRICS])
    gradient = jax.jit(jax.vmap(jax.jacrev(function, argnums=1)))(*singular_states(np.float32))
    assert gradient.dtype == np.float32
    assert np.all(np.isfinite(gradient))
    assert abs(gradient).max() < 100  # a norm's slope is 1, weights are up to 3
    assert not gradient[:2, : len(at_a_match)].any()
