"""What a policy observes of an expert that is measured."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.envs.imitation import observed_parts
from mimic.envs.make import make_env
from mimic.envs.seen_expert import see
from mimic.physics.world import WorldConfig

TICKS, DT, NOISE = 50, 0.05, 0.01


@pytest.fixture(scope="module")
def env():
    return mimic.make("panda3dof", demonstrations={"count": 2, "held_out": 1}, world="unknown")


@pytest.fixture(scope="module")
def states(env):
    """The link states of a demonstration, [ticks, links, 3] each."""
    return jax.tree.map(lambda x: x[0, :TICKS], env.expert_states)


def seen(states, keys: Any = 0, step: int = 0, **world):
    """What an episode of a key sees, or those of several keys."""
    config, keys = WorldConfig(**{"expert": "links", **world}), np.asarray(keys)
    of_key = lambda key: see(config, states, jax.random.PRNGKey(key), jnp.asarray(step), DT)  # noqa: E731
    return jax.jit(jax.vmap(of_key) if keys.ndim else of_key)(keys)


def test_without_noise_and_gaps_it_is_the_expert(states):
    result = seen(states)
    assert np.all(result.visible)
    jax.tree.map(np.testing.assert_array_equal, observed_parts(result.states), observed_parts(states))
    rows = [np.asarray(x).reshape(TICKS, -1) for x in [*observed_parts(states), np.ones(result.visible.shape)]]
    np.testing.assert_array_equal(result.vector(), np.concatenate(rows, axis=1).ravel())


def test_candidate_points_have_no_directions(states):
    result = seen(states, expert="points")
    assert result.states.direction is None and result.states.angular_velocity is None and result.states.hand is None
    assert result.vector().size == TICKS * 7 * (3 + 3 + 1)


def test_velocities_are_those_of_differences_of_noisy_measurements(states):
    result = seen(states, expert_noise=[NOISE, NOISE]).states
    for values, velocities in (("position", "linear_velocity"), ("direction", "angular_velocity")):
        noise = np.asarray(getattr(result, values) - getattr(states, values))
        assert noise.std() == pytest.approx(NOISE, rel=0.1)  # of 1050 numbers
        error = np.asarray(getattr(result, velocities) - getattr(states, velocities))
        np.testing.assert_allclose(error[1:], np.diff(noise, axis=0) / DT, atol=1e-4)


def test_a_tick_is_measured_once(states):
    """What is seen ahead is what is seen there later."""
    settings = {"expert_noise": [NOISE, NOISE], "expert_loss": 0.3, "hidden_links": [1, 3]}
    whole = seen(states, **settings)
    later = seen(jax.tree.map(lambda x: x[7:12], states), step=7, **settings)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[7:12], atol=1e-5), later, whole)


def test_no_velocity_is_seen_where_the_tick_before_was_lost(states):
    result = seen(states, expert_loss=0.3, expert_noise=[NOISE, NOISE])
    lost = ~np.asarray(result.visible).any(axis=1)
    assert lost.any() and not np.any(result.states.linear_velocity[1:][lost[:-1]])
    assert np.any(result.states.linear_velocity[1:][~lost[:-1]])


def test_hidden_links_are_hidden_for_a_whole_episode_and_lost_ticks_as_a_whole(states):
    counts, lost = set(), []
    for visible in np.asarray(seen(states, np.arange(20), hidden_links=[0, 2], expert_loss=0.2).visible):
        ticks = visible.any(axis=1)
        assert np.all(visible[ticks] == visible[ticks][0])
        counts.add(int((~visible[ticks][0]).sum()))
        lost.append(1 - ticks.mean())
    assert counts == {0, 1, 2} and np.mean(lost) == pytest.approx(0.2, abs=0.06)  # four deviations of 1000 ticks


@pytest.fixture(scope="module")
def noisy(env):
    world = dataclasses.replace(env.world, expert="points", expert_noise=[0.1, 0.1], hidden_links=[2, 2])
    return make_env(dataclasses.replace(env.config, world=world), env.demonstrations)


def test_the_policy_observes_it_and_the_critic_the_truth(env, noisy):
    def observed(key):
        state = noisy.start(key)
        return noisy.observe(state), noisy.seen_expert(state, state.step, 5).vector()

    obs, vector = jax.jit(observed)(jax.random.PRNGKey(3))
    assert vector.size == 5 * 7 * (3 + 3 + 1)
    own = 7 * 12 + 2 * 3  # the learner's link states and two axes of its hand
    np.testing.assert_array_equal(obs[own : own + vector.size], vector)
    assert obs.size == noisy.observation_size == env.observation_size - 5 * own + vector.size
    assert noisy.privileged_size == env.privileged_size + own


@pytest.mark.slow
def test_the_reward_compares_the_true_expert(env, noisy):
    rewards = [
        jax.jit(lambda each=each: each.step(each.reset(jax.random.PRNGKey(3)), jnp.zeros(3)).reward)()
        for each in (env, noisy)
    ]
    np.testing.assert_array_equal(*rewards)
