"""PPO's losses of a minibatch: clipped surrogate and entropy, value error (Schulman et al., 2017).

Their sum equals brax's `compute_ppo_loss` for episodes that terminate and are never truncated, as those of our
environments; only the random sample that estimates the entropy differs. There are two losses because policy and value
network have no parameter in common. On a GPU a training is many small kernels, so the losses need few of them: no loop
over a few steps, one pass of the value network, few metrics.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import networks as ppo_networks
from jaxtyping import Array, Float

from mimic.trainers.config import PPOConfig

METRICS = ("policy_loss", "entropy", "approx_kl", "clip_fraction", "action_std")  # of the policy
_VALUE_WEIGHT = 0.25  # of the squared value error in the loss
_UNROLLED_STEPS = 32  # steps of the advantage estimate in one kernel


class Unrolls(NamedTuple):
    """Unrolls: consecutive steps of arms. The last sample in time has the final observation; its other fields are zero.

    Attributes:
      observation: [*unrolls, time + 1, n] before the step.
      raw_action: [*unrolls, time + 1, m] sample of the policy's normal distribution, before the tanh.
      log_prob: [*unrolls, time + 1] log-probability of the action under the policy that took it.
      reward: [*unrolls, time + 1].
      goes_on: [*unrolls, time + 1] 0 where the episode ended with the step, else 1.
      elapsed: [*unrolls, time + 1] fraction of the episode before the step; the final observation has it too.
    """

    observation: Array
    raw_action: Array
    log_prob: Array
    reward: Array
    goes_on: Array
    elapsed: Array

    def packed(self) -> Array:
        """All fields, concatenated along the last axis, so that one kernel gathers a minibatch."""
        return jnp.concatenate([x if x.ndim == self.observation.ndim else x[..., None] for x in self], axis=-1)

    def unpacked(self, rows: Array) -> "Unrolls":
        """The unrolls of any number of rows of `packed`."""
        ends = self.observation.shape[-1], self.observation.shape[-1] + self.raw_action.shape[-1]
        observation, raw_action, rest = jnp.split(rows, ends, axis=-1)
        return Unrolls(observation, raw_action, *jnp.moveaxis(rest, -1, 0))


def value_loss(
    params: Any,
    statistics: RunningStatisticsState,
    unrolls: Unrolls,
    networks: ppo_networks.PPONetworks,
    config: PPOConfig,
) -> tuple[Array, Float[Array, "unrolls time"]]:
    """The loss of the value network, and the normalised advantages for the policy's loss.

    Args:
      params: parameters of the value network.
      statistics: running statistics of the observations.
      unrolls: [unrolls, time + 1, ...].
      networks: policy and value network.
      config: the trainer's settings.
    """
    observation = unrolls.observation
    if config.timed_critic:
        observation = jnp.concatenate([observation, unrolls.elapsed[..., None]], axis=-1)
    values = networks.value_network.apply(statistics, params, observation)
    reward, goes_on = unrolls.reward[:, :-1], unrolls.goes_on[:, :-1]
    targets, advantages = jax.lax.stop_gradient(
        compute_gae(config.reward_scaling * reward, config.discounting * goes_on, values, config.gae_lambda)
    )
    loss = _VALUE_WEIGHT * jnp.square(targets - values[:, :-1]).mean()
    return loss, (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def policy_loss(
    params: Any,
    statistics: RunningStatisticsState,
    unrolls: Unrolls,
    advantages: Float[Array, "unrolls time"],
    key: Array,
    networks: ppo_networks.PPONetworks,
    config: PPOConfig,
) -> tuple[Array, Float[Array, " metrics"]]:
    """The loss of the policy network, including the entropy, and the values of `METRICS`.

    Args:
      params: parameters of the policy network.
      statistics: running statistics of the observations.
      unrolls: [unrolls, time + 1, ...].
      advantages: from `value_loss`.
      key: for the sampled estimate of the entropy.
      networks: policy and value network.
      config: the trainer's settings.
    """
    logits = networks.policy_network.apply(statistics, params, unrolls.observation[:, :-1])
    raw_action, old_log_prob = unrolls.raw_action[:, :-1], unrolls.log_prob[:, :-1]
    actions = networks.parametric_action_distribution
    log_ratio = actions.log_prob(logits, raw_action) - old_log_prob
    ratio, lower, upper = jnp.exp(log_ratio), 1 - config.clipping_epsilon, 1 + config.clipping_epsilon
    surrogate = -jnp.minimum(ratio * advantages, jnp.clip(ratio, lower, upper) * advantages)
    entropy = actions.entropy(logits, key)
    loss = surrogate.mean() - config.entropy_cost * entropy.mean()

    approx_kl = ratio - 1 - log_ratio
    clipped = (ratio < lower) | (ratio > upper)
    action_std = actions.create_dist(logits).scale.mean(axis=-1)  # type: ignore[attr-defined]
    terms = jax.lax.stop_gradient(jnp.stack([surrogate, entropy, approx_kl, clipped, action_std]))
    # One mean over all terms instead of one for each: an update takes 208 instead of 217 us on an H200. The barrier
    # keeps XLA from fusing both into a kernel of few threads, which costs 38 us where kernels are not concurrent.
    return loss, jax.lax.optimization_barrier(terms).mean(axis=(1, 2))


def compute_gae(
    reward: Float[Array, "unrolls time"],
    discount: Float[Array, "unrolls time"],
    values: Float[Array, "unrolls time+1"],
    gae_lambda: float,
) -> tuple[Float[Array, "unrolls time"], Float[Array, "unrolls time"]]:
    """Value targets and advantages by generalised advantage estimation (Schulman et al., 2016).

    As in brax, the advantage of a step is reward + discount * (target of the next step) - value.

    Args:
      reward: of each step.
      discount: factor on the value after each step; 0 where the episode ended.
      values: of the observation before each step, and after the last step.
      gae_lambda: 0 bootstraps from the value after one step, 1 uses rewards up to the end of the unroll.
    """
    errors = reward + discount * values[:, 1:] - values[:, :-1]

    def accumulate(next_sum: Array, step: Any) -> tuple[Array, Array]:
        error, decay = step
        error_sum = error + decay * next_sum
        return error_sum, error_sum

    steps = errors.T, gae_lambda * discount.T
    unroll = min(len(errors.T), _UNROLLED_STEPS)
    _, error_sums = jax.lax.scan(accumulate, jnp.zeros_like(reward[:, 0]), steps, reverse=True, unroll=unroll)
    targets = error_sums.T + values[:, :-1]
    next_targets = jnp.concatenate([targets[:, 1:], values[:, -1:]], axis=1)
    return targets, reward + discount * next_targets - values[:, :-1]
