"""Model predictive control along an expert of which the next steps are known."""

import jax
import jax.numpy as jnp
import numpy as np

from mimic.arms.embodiment import panda
from mimic.evaluation.predictive_controller import EXTRAPOLATED, _without_negative, ahead
from mimic.metric.kinematics import link_states

DT = 0.01


def test_the_expert_moves_on_with_its_velocities():
    """To second order in time: of 1e-4 after four steps of 10 ms at some rad/s."""
    arm, rate = panda(), jnp.linspace(-0.5, 0.5, 7)
    qpos = arm.home + DT * jnp.arange(EXTRAPOLATED + 3)[:, None] * rate
    states = jax.jit(jax.vmap(lambda x: link_states(arm, x, rate)))(qpos)
    known = jax.tree.map(lambda x: x[:3], states)
    result = ahead(known, DT)
    assert len(result.position) == 2 + EXTRAPOLATED
    for name in ("position", "direction"):
        np.testing.assert_allclose(getattr(result, name), getattr(states, name)[1:], atol=2e-3)
        np.testing.assert_array_equal(getattr(result, name)[:2], getattr(states, name)[1:3])
    np.testing.assert_allclose(result.hand.axes, states.hand.axes[1:], atol=2e-3)
    assert np.abs(states.hand.axes[-1] - states.hand.axes[2]).max() > 0.02


def test_negative_curvature_is_cut():
    matrix = jnp.diag(jnp.array([2.0, -1.0, 0.5]))
    np.testing.assert_allclose(_without_negative(matrix[None])[0], np.diag([2.0, 0.0, 0.5]), atol=1e-6)
