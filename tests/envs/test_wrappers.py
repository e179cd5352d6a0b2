"""Restarts of episodes within a batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.envs.wrappers import wrap_for_training
from tests.helpers.tiny import SHORT_ARMS

FEW = {"count": 6, "held_out": 2}


@pytest.fixture(scope="module")
def planar_env():
    return mimic.make("planar4dof", **SHORT_ARMS, demonstrations=FEW)


def test_episodes_end_at_the_horizon_and_draw_new_demonstrations(planar_env):
    env = wrap_for_training(planar_env, planar_env.config.horizon + 1)
    count, horizon = 32, planar_env.config.horizon

    @jax.jit
    def rollout(state):
        def step(state, _):
            state = env.step(state, jnp.zeros((count, planar_env.action_size)))
            arm = state.pipeline_state
            return state, (state.done, state.info["truncation"], arm.demonstration, arm.step)

        return jax.lax.scan(step, state, None, length=3 * horizon)[1]

    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), count))
    assert len(np.unique(state.pipeline_state.step)) > 10  # the first episodes are out of step with each other
    done, truncation, demonstration, step = map(np.asarray, rollout(state))
    assert np.all(done.sum(axis=0) == 3)
    assert not truncation.any()
    assert np.all(step[done.astype(bool)] == 0)
    assert all(len(np.unique(demonstration[:, i])) > 1 for i in range(count) if i % 8 == 0)


def test_a_function_that_jax_has_stays(planar_env, monkeypatch):
    monkeypatch.setattr(jax, "device_put_replicated", "of JAX", raising=False)
    mimic.ImitationEnv(planar_env.config, planar_env.demonstrations)
    assert jax.device_put_replicated == "of JAX"
