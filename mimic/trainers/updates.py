"""PPO's updates of policy and value from what the arms did, over all devices."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import networks as ppo_networks
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo_loss import METRICS as OF_POLICY
from mimic.trainers.ppo_loss import Unrolls, policy_loss, value_loss

METRICS = ("value_loss", *OF_POLICY)


class Learner(NamedTuple):
    """Policy or value.

    Attributes:
      params: of the network.
      optimizer: state of optax, of all parameters as one vector: a step is one kernel.
    """

    params: Any
    optimizer: optax.OptState


def begin(params: Any, optimizer: optax.GradientTransformation) -> Learner:
    """A network that has not learned yet."""
    return Learner(params, optimizer.init(ravel_pytree(params)[0]))


def updated(
    policy: Learner,
    value: Learner,
    statistics: RunningStatisticsState,
    unrolls: Unrolls,
    order: Int[Array, "updates minibatch"],
    key: Array,
    networks: ppo_networks.PPONetworks,
    config: PPOConfig,
    optimizer: optax.GradientTransformation,
    axis: str,
    staggered: bool,
    unroll: int,
) -> tuple[Learner, Learner, Float[Array, " metrics"]]:
    """Policy and value after an update by each minibatch, and the means of `METRICS` on this device.

    The policy's gradient is clipped by the norm of both, as by brax; the value's by its own norm, which is most of that
    of both.

    Args:
      policy: before.
      value: before.
      statistics: of the observations.
      unrolls: [unrolls, time + 1, ...] of this device.
      order: which unrolls each update learns from.
      key: of this device, for the entropy, which is estimated by a sample.
      networks: of the config.
      config: resolved.
      optimizer: of both.
      axis: over the devices.
      staggered: whether the policy takes its step when the value has begun with the next minibatch. Each waits for the
        mean of its gradients over the devices while the other computes, and what they learn is the same. Else both take
        their steps at once, after one message.
      unroll: updates in each pass of the compiled loop.
    """
    rows = unrolls.packed()

    def of_value(learner: Learner, given: Any) -> tuple[Array, Array, Array]:
        differentiated = jax.value_and_grad(value_loss, has_aux=True)
        (error, advantages), gradients = differentiated(learner.params, *given, networks, config)
        return ravel_pytree(gradients)[0], error, advantages

    def of_policy(learner: Learner, given: Any, advantages: Array, key: Array) -> tuple[Array, Array]:
        differentiated = jax.grad(policy_loss, has_aux=True)
        gradients, metrics = differentiated(learner.params, *given, advantages, key, networks, config)
        return ravel_pytree(gradients)[0], metrics

    def step(learner: Learner, gradient: Array, norm: Array) -> Learner:
        clipped = gradient * jnp.minimum(1, config.max_grad_norm / norm)
        change, state = optimizer.update(clipped, learner.optimizer)
        unravel = ravel_pytree(learner.params)[1]
        return Learner(optax.apply_updates(learner.params, unravel(change)), state)

    def at_once(carry: Any, inputs: Any) -> Any:
        policy, value = carry
        chosen, key, _ = inputs
        given = statistics, unrolls.unpacked(rows[chosen])
        gradient, error, advantages = of_value(value, given)
        policy_gradient, metrics = of_policy(policy, given, advantages, key)
        mean = jax.lax.pmean(jnp.concatenate([policy_gradient, gradient]), axis)
        policy_mean, value_mean = mean[: len(policy_gradient)], mean[len(policy_gradient) :]
        learners = step(policy, policy_mean, _norm(mean)), step(value, value_mean, _norm(value_mean))
        return learners, jnp.append(error, metrics)

    # NCCL must not be given two messages at once: each has the norm in it that comes of the one before.
    def in_turn(carry: Any, inputs: Any) -> Any:
        policy, value, message = carry
        chosen, key, first = inputs
        given = statistics, unrolls.unpacked(rows[chosen])
        stepped, norm = policy_step(policy, message)
        policy = jax.tree.map(lambda old, new: jnp.where(first, old, new), policy, stepped)
        policy = jax.lax.optimization_barrier(policy)  # else XLA copies the message before it sends it
        gradient, error, advantages = of_value(value, given)
        advantages += 0 * gradient[0]  # after the gradient: beside its message the policy's is computed
        mean = jax.lax.pmean(jnp.append(gradient, norm), axis)[:-1]
        value_norm = _norm(mean)
        gradient, metrics = of_policy(policy, given, advantages, key)
        return (policy, step(value, mean, value_norm), jnp.append(gradient, value_norm)), jnp.append(error, metrics)

    def policy_step(policy: Learner, message: Array) -> tuple[Learner, Array]:
        mean = jax.lax.pmean(message, axis)
        norm = _norm(mean[:-1])
        return step(policy, mean[:-1], jnp.hypot(norm, mean[-1])), norm

    inputs = order, jax.random.split(key, len(order)), jnp.arange(len(order)) == 0
    if not staggered:
        (policy, value), metrics = jax.lax.scan(at_once, (policy, value), inputs, unroll=unroll)
        return policy, value, metrics.mean(axis=0)
    none = 0 * ravel_pytree(policy.params)[0]
    after = 0 * ravel_pytree(statistics.mean)[0].sum()  # the statistics were sent before
    nothing = jnp.append(none, after.astype(none.dtype))
    (policy, value, message), metrics = jax.lax.scan(in_turn, (policy, value, nothing), inputs, unroll=unroll)
    policy, norm = policy_step(policy, message)
    return policy, value, metrics.mean(axis=0) + 0 * norm  # they may be sent next


def _norm(vector: Array) -> Array:
    return jnp.sqrt(jnp.sum(jnp.square(vector)))
