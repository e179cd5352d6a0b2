"""The policy of any arm, with a token for each joint."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs

from mimic.arms.arrays import MAX_JOINTS
from mimic.envs.many_arms_observation import JOINT_FEATURES, observation_size
from mimic.trainers.config import PPOConfig
from mimic.trainers.networks import Transformer
from mimic.trainers.ppo.ppo import make_networks

SIZE, ACTIONS = observation_size(7), MAX_JOINTS
LOCKED = np.array([0, 0, 1, 0, 0, 0, 0, 1], bool)


@pytest.fixture(scope="module")
def policy():
    """The distribution's parameters as a function of an observation; for untrained and for random parameters."""
    networks = make_networks(PPOConfig(hidden_layers=[8], network="joints").resolve(), SIZE, ACTIONS, 1)
    statistics = running_statistics.init_state(specs.Array((SIZE,), jnp.dtype("float32")))
    params = jax.jit(networks.policy_network.init)(jax.random.PRNGKey(0))
    leaves, structure = jax.tree.flatten(params)
    rng = np.random.default_rng(1)
    noise = [rng.normal(0, 0.3, leaf.shape).astype(np.float32) for leaf in leaves]
    apply = jax.jit(lambda params, observation: networks.policy_network.apply(statistics, params, observation))
    return apply, params, jax.tree.unflatten(structure, noise), networks


@pytest.fixture(scope="module")
def observations():
    values = np.random.default_rng(0).normal(size=(5, SIZE)).astype(np.float32)
    of_joints = values[:, : JOINT_FEATURES * MAX_JOINTS].reshape(5, MAX_JOINTS, JOINT_FEATURES)
    of_joints[..., 0] = ~LOCKED
    return values


def test_an_untrained_policy_is_the_controller_with_little_noise(policy, observations):
    apply, params, _, networks = policy
    mean, raw = np.split(np.asarray(apply(params, observations)), 2, axis=-1)
    assert mean.shape == (5, ACTIONS) and not mean.any()
    scale = networks.parametric_action_distribution.create_dist(jnp.concatenate([mean, raw], axis=-1)).scale
    np.testing.assert_allclose(scale, 0.051, atol=1e-3)  # brax adds 0.001


def test_batches_of_any_shape(policy, observations):
    apply, _, random, _ = policy
    outputs = apply(random, observations)
    np.testing.assert_allclose(apply(random, observations[0]), outputs[0], atol=1e-5)
    np.testing.assert_allclose(apply(random, observations[:4].reshape(2, 2, SIZE))[1, 0], outputs[2], atol=1e-5)
    assert len(np.unique(np.round(outputs, 4), axis=0)) == 5


def test_locked_joints_do_not_change_the_actions_of_others(policy, observations):
    apply, _, random, _ = policy
    changed = observations.copy()
    of_joints = changed[:, : JOINT_FEATURES * MAX_JOINTS].reshape(5, MAX_JOINTS, JOINT_FEATURES)
    of_joints[:, LOCKED, 1:] += 1.0
    before, after = (np.split(np.asarray(apply(random, x)), 2, axis=-1)[0] for x in (observations, changed))
    np.testing.assert_allclose(after[:, ~LOCKED], before[:, ~LOCKED], atol=1e-5)
    of_joints[:, ~LOCKED, 1:] += 1.0
    assert np.abs(np.asarray(apply(random, changed))[:, :MAX_JOINTS] - before).max() > 1e-2


def test_what_was_constant_in_training_does_not_explode(policy, observations):
    """Statistics of observations in which the first arm's last features were always 0."""
    networks = policy[3]
    seen = observations.copy()
    seen[:, -20:] = 0.0
    statistics = running_statistics.update(
        running_statistics.init_state(specs.Array((SIZE,), jnp.dtype("float32"))), jnp.asarray(seen)
    )
    actions = jax.jit(networks.policy_network.apply)(statistics, policy[2], observations)
    unclipped = running_statistics.normalize(jnp.asarray(observations), statistics)
    assert np.abs(unclipped).max() > 1e5  # brax's own
    params = jax.jit(networks.value_network.init)(jax.random.PRNGKey(0))
    timed = np.concatenate([observations, np.ones((5, 1), np.float32)], axis=-1)
    values = jax.jit(networks.value_network.apply)(statistics, params, timed)
    assert np.abs(actions).max() < 100 and np.abs(values).max() < 100


def test_missing_tokens_change_no_other():
    module, tokens = Transformer(8, 2), np.random.default_rng(0).normal(size=(3, 6, 8)).astype(np.float32)
    present = np.arange(6) < 4
    everywhere = np.broadcast_to(present, (3, 6))
    params = jax.jit(module.init)(jax.random.PRNGKey(1), tokens, everywhere)
    other = np.where(present[:, None], tokens, np.float32(5.0))
    apply = jax.jit(module.apply)
    outputs = [np.asarray(apply(params, x, everywhere)) for x in (tokens, other)]
    np.testing.assert_allclose(outputs[0][:, :4], outputs[1][:, :4], atol=1e-6)
