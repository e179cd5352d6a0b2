"""The networks of PPO: brax's, and a policy for any arm with a token for each joint."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.training import networks as brax_networks
from brax.training.acme import running_statistics
from brax.training.agents.ppo import networks as ppo_networks
from flax import linen as nn
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS
from mimic.envs.many_arms_observation import JOINT_FEATURES
from mimic.trainers.config import PPOConfig
from mimic.trainers.networks import Transformer

# Standard deviation of an untrained policy, whose mean is the zero action: the controller is good from the start, and
# noise of the usual size would hide it.
_JOINT_STD = 0.05
_MIN_DEVIATION, _MAX_NORMALIZED = 0.1, 10.0  # of an observation of any arm, whose entries are of the order of 1


def make_networks(config: PPOConfig, observation_size: int, action_size: int) -> ppo_networks.PPONetworks:
    """The policy and value network of the trainer's settings."""
    hidden = tuple(config.hidden_layers or ())
    layers = {"policy_hidden_layer_sizes": hidden, "value_hidden_layer_sizes": hidden}
    make = functools.partial(ppo_networks.make_ppo_networks, action_size=action_size, **layers)
    normalize = _normalize_bounded if config.network == "joints" else running_statistics.normalize
    networks = make(observation_size, preprocess_observations_fn=normalize)
    if config.timed_critic:
        timed = make(observation_size + 1, preprocess_observations_fn=_all_but_last(normalize))
        networks = dataclasses.replace(networks, value_network=timed.value_network)
    if config.network == "joints":
        networks = dataclasses.replace(networks, policy_network=_joint_policy(observation_size))
    return networks


Normalize = Callable[[Array, running_statistics.RunningStatisticsState], Array]


def _all_but_last(normalize: Normalize) -> Normalize:
    """Normalises all entries of an observation but the last one: the elapsed fraction of the episode."""

    def normalized(observation: Array, statistics: running_statistics.RunningStatisticsState) -> Array:
        return jnp.concatenate([normalize(observation[..., :-1], statistics), observation[..., -1:]], axis=-1)

    return normalized


def _normalize_bounded(observation: Array, statistics: running_statistics.RunningStatisticsState) -> Array:
    """The normalised observation of any arm, in [-10, 10].

    What has been the same on all arms of a training, such as an empty slot, has a deviation of 0. An arm with another
    value there would otherwise have an entry of a million.
    """
    std = jax.tree.map(lambda x: jnp.maximum(x, _MIN_DEVIATION), statistics.std)
    return running_statistics.normalize(observation, statistics.replace(std=std), max_abs_value=_MAX_NORMALIZED)


def _joint_policy(observation_size: int) -> brax_networks.FeedForwardNetwork:
    """The policy of any arm as brax's type of network."""
    module = JointPolicy()

    def init(key: Array) -> Any:
        return module.init(key, jnp.zeros(observation_size), jnp.ones(MAX_JOINTS))

    def apply(statistics: Any, params: Any, observation: Array) -> Any:
        is_free = observation[..., : JOINT_FEATURES * MAX_JOINTS : JOINT_FEATURES]
        return module.apply(params, _normalize_bounded(observation, statistics), is_free)

    return brax_networks.FeedForwardNetwork(init=init, apply=apply)


class JointPolicy(nn.Module):
    """A policy of any arm: a token for each joint, with the same weights for all of them but for its place.

    Attributes:
      width: of a token.
      layers: of the transformer.
      summary: width of the layer between the numbers of the whole arm and the tokens.
    """

    width: int = 64
    layers: int = 2
    summary: int = 128

    @nn.compact
    def __call__(
        self, observation: Float[Array, "*batch observation"], is_free: Float[Array, "*batch joints"]
    ) -> Float[Array, "*batch parameters"]:
        """Parameters of brax's normal distribution: means, then deviations before its softplus.

        Args:
          observation: of `mimic.envs.many_arms_observation.observe`, normalised.
          is_free: 1 for a joint that moves, 0 for a locked one.
        """
        split = JOINT_FEATURES * MAX_JOINTS
        of_joints = observation[..., :split].reshape(*observation.shape[:-1], MAX_JOINTS, JOINT_FEATURES)
        whole = nn.Dense(self.width)(nn.silu(nn.Dense(self.summary)(observation[..., split:])))
        place = self.param("place", nn.initializers.normal(0.02), (MAX_JOINTS, self.width))
        tokens = nn.Dense(self.width)(of_joints) + place + whole[..., None, :]
        tokens = Transformer(self.width, self.layers)(tokens, is_free > 0)
        bias = jnp.array([0.0, np.log(np.expm1(_JOINT_STD))])  # mean and deviation, whatever the observation is
        actions = nn.Dense(2, kernel_init=nn.initializers.zeros, bias_init=lambda *_: bias, name="joints")(tokens)
        return jnp.concatenate([actions[..., 0], actions[..., 1]], axis=-1)
