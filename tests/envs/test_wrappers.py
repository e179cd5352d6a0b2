"""Restarts of episodes within a batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers import training as brax_training
from brax.training import pmap as brax_pmap

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


@pytest.fixture(scope="module")
def short_env():
    return mimic.make("planar4dof", **SHORT_ARMS, physics="fused", horizon=2, demonstrations=FEW)


def demonstrations_over_time(wrapped, env, steps=6, count=8):
    """The demonstration of each arm after each step, [time, arms]."""
    action = jnp.zeros((count, env.action_size))

    @jax.jit
    def rollout(key):
        def step(state, _):
            state = wrapped.step(state, action)
            return state, state.pipeline_state.demonstration

        return jax.lax.scan(step, wrapped.reset(jax.random.split(key, count)), None, length=steps)[1]

    return np.asarray(rollout(jax.random.PRNGKey(0)))


@pytest.mark.slow
def test_an_environment_works_in_brax_trainers(short_env, monkeypatch):
    """Their training loops copy the state to all devices by a function that JAX removed."""
    monkeypatch.delattr(jax, "device_put_replicated", raising=False)
    env = mimic.ImitationEnv(short_env.config, short_env.demonstrations)
    copied = brax_pmap.bcast_local_devices({"a": jnp.arange(3.0)}, 1)
    np.testing.assert_array_equal(copied["a"], [[0.0, 1.0, 2.0]])
    # brax's own wrapper, the default of its trainers, repeats one demonstration for each arm; mimic's draws new ones.
    repeated = demonstrations_over_time(brax_training.wrap(env, episode_length=2), env)
    assert (repeated == repeated[0]).all()
    drawn = demonstrations_over_time(wrap_for_training(env, 2), env)
    assert (drawn != drawn[0]).any(axis=0).all()


def test_a_function_that_jax_has_stays(short_env, monkeypatch):
    monkeypatch.setattr(jax, "device_put_replicated", "of JAX", raising=False)
    mimic.ImitationEnv(short_env.config, short_env.demonstrations)
    assert jax.device_put_replicated == "of JAX"
