"""PPO's losses of a minibatch: clipped surrogate and entropy, error of the value (Schulman et al., 2017).

Together they equal brax's `compute_ppo_loss`, as far as our environments ask for it: episodes end, and are not cut off.
Only the sample that the entropy is estimated by is drawn in another order. They are two, since policy and value have no
parameter in common. On a GPU a training is many small kernels, so here is little that asks for one of its own: no loop
over a few steps, one pass of the value network, few metrics.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import networks as ppo_networks
from jaxtyping import Array, Float

from mimic.trainers.config import PPOSettings

METRICS = ("policy_loss", "entropy", "approx_kl", "clip_fraction", "action_std")  # of the policy
_VALUE_SHARE = 0.25  # of the squared error of the value
_UNROLLED = 32  # steps of the advantage estimate that become one kernel


class Unrolls(NamedTuple):
    """Steps of arms, each unroll with what is seen after its last one: of that the observation alone counts.

    Attributes:
      observation: [*unrolls, time + 1, n].
      raw_action: [*unrolls, time + 1, m] sample of the policy's normal distribution, before it is squashed.
      log_prob: [*unrolls, time + 1] of the action, when it was taken.
      reward: [*unrolls, time + 1].
      goes_on: [*unrolls, time + 1] 0 where the episode ended with the step, else 1.
    """

    observation: Array
    raw_action: Array
    log_prob: Array
    reward: Array
    goes_on: Array

    def packed(self) -> Array:
        """Side by side along the last axis, so that a minibatch is gathered by one kernel."""
        return jnp.concatenate([x if x.ndim == self.observation.ndim else x[..., None] for x in self], axis=-1)

    def unpacked(self, rows: Array) -> "Unrolls":
        """The reverse, of as many rows as there are."""
        ends = self.observation.shape[-1], self.observation.shape[-1] + self.raw_action.shape[-1]
        observation, raw_action, rest = jnp.split(rows, ends, axis=-1)
        return Unrolls(observation, raw_action, *jnp.moveaxis(rest, -1, 0))


def value_loss(
    params: Any,
    statistics: RunningStatisticsState,
    unrolls: Unrolls,
    networks: ppo_networks.PPONetworks,
    config: PPOSettings,
) -> tuple[Array, Float[Array, "unrolls time"]]:
    """The loss of the value, and the advantages, normalised, that the policy learns from.

    Args:
      params: of the value.
      statistics: of the observations.
      unrolls: [unrolls, time + 1, ...].
      networks: of the config.
      config: resolved.
    """
    values = networks.value_network.apply(statistics, params, unrolls.observation)
    reward, goes_on = unrolls.reward[:, :-1], unrolls.goes_on[:, :-1]
    targets, advantages = jax.lax.stop_gradient(
        compute_gae(config.reward_scaling * reward, config.discounting * goes_on, values, config.gae_lambda)
    )
    loss = _VALUE_SHARE * jnp.square(targets - values[:, :-1]).mean()
    return loss, (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def policy_loss(
    params: Any,
    statistics: RunningStatisticsState,
    unrolls: Unrolls,
    advantages: Float[Array, "unrolls time"],
    key: Array,
    networks: ppo_networks.PPONetworks,
    config: PPOSettings,
) -> tuple[Array, Float[Array, " metrics"]]:
    """The loss of the policy, entropy included, and `METRICS`.

    Args:
      params: of the policy.
      statistics: of the observations.
      unrolls: [unrolls, time + 1, ...].
      advantages: of `value_loss`.
      key: for the entropy, which is estimated by a sample.
      networks: of the config.
      config: resolved.
    """
    logits = networks.policy_network.apply(statistics, params, unrolls.observation[:, :-1])
    raw_action, old_log_prob = unrolls.raw_action[:, :-1], unrolls.log_prob[:, :-1]
    actions = networks.parametric_action_distribution
    log_ratio = actions.log_prob(logits, raw_action) - old_log_prob
    ratio, least, most = jnp.exp(log_ratio), 1 - config.clipping_epsilon, 1 + config.clipping_epsilon
    surrogate = -jnp.minimum(ratio * advantages, jnp.clip(ratio, least, most) * advantages)
    entropy = actions.entropy(logits, key)
    loss = surrogate.mean() - config.entropy_cost * entropy.mean()

    approx_kl = ratio - 1 - log_ratio
    clipped = (ratio < least) | (ratio > most)
    action_std = actions.create_dist(logits).scale.mean(axis=-1)  # type: ignore[attr-defined]
    terms = jax.lax.stop_gradient(jnp.stack([surrogate, entropy, approx_kl, clipped, action_std]))
    # One mean of all terms, not one of each: 208 instead of 217 us an update on an H200. The barrier keeps XLA from
    # fusing both in few threads, which costs 38 us where kernels run one after the other.
    return loss, jax.lax.optimization_barrier(terms).mean(axis=(1, 2))


def compute_gae(
    reward: Float[Array, "unrolls time"],
    discount: Float[Array, "unrolls time"],
    values: Float[Array, "unrolls time+1"],
    gae_lambda: float,
) -> tuple[Float[Array, "unrolls time"], Float[Array, "unrolls time"]]:
    """Targets of the value and advantages, by generalised advantage estimation (Schulman et al., 2016).

    The advantage is that of an action against the value, where the target of the next step is what comes of it.

    Args:
      reward: of each step.
      discount: of what comes after it; 0 where the episode ended.
      values: of what is seen before each step, and after the last one.
      gae_lambda: 0 trusts the value after one step, 1 not at all.
    """
    errors = reward + discount * values[:, 1:] - values[:, :-1]

    def back(later: Array, step: Any) -> tuple[Array, Array]:
        error, decay = step
        now = error + decay * later
        return now, now

    steps = errors.T, gae_lambda * discount.T
    _, above = jax.lax.scan(
        back, jnp.zeros_like(reward[:, 0]), steps, reverse=True, unroll=min(len(errors.T), _UNROLLED)
    )
    targets = above.T + values[:, :-1]
    after = jnp.concatenate([targets[:, 1:], values[:, -1:]], axis=1)
    return targets, reward + discount * after - values[:, :-1]
