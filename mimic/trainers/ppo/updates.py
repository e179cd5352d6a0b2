"""PPO's updates of policy and value from what the arms did, over all devices."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import networks as ppo_networks
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from mimic.trainers.config import PPOSettings
from mimic.trainers.ppo.losses import METRICS as OF_POLICY
from mimic.trainers.ppo.losses import Unrolls, policy_loss, value_loss

METRICS = ("value_loss", *OF_POLICY)


class TrainState(NamedTuple):
    """Policy or value.

    Attributes:
      params: of the network.
      optimizer: state of optax, of all parameters as one vector: a step is one kernel.
    """

    params: Any
    optimizer: optax.OptState


TrainStates = tuple[TrainState, TrainState]  # policy, value


def begin(params: Any, optimizer: optax.GradientTransformation) -> TrainState:
    """A network that has not learned yet."""
    return TrainState(params, optimizer.init(ravel_pytree(params)[0]))


class UpdateConfig(NamedTuple):
    """How policy and value are updated, the same for all of a run.

    Attributes:
      networks: of the config.
      config: resolved.
      optimizer: of both.
      axis: over the devices.
      staggered: whether the policy takes its step when the value has begun with the next minibatch. Each waits for the
        mean of its gradients over the devices while the other computes, and what they learn is the same. Else both take
        their steps at once, after one message.
      unroll: updates in each pass of the compiled loop.
    """

    networks: ppo_networks.PPONetworks
    config: PPOSettings
    optimizer: optax.GradientTransformation
    axis: str
    staggered: bool
    unroll: int


def updated(
    learners: TrainStates,
    statistics: RunningStatisticsState,
    unrolls: Unrolls,
    order: Int[Array, "updates minibatch"],
    key: Array,
    how: UpdateConfig,
) -> tuple[TrainStates, Float[Array, " metrics"]]:
    """Policy and value after an update by each minibatch, and the means of `METRICS` on this device.

    The policy's gradient is clipped by the norm of both, as by brax; the value's by its own norm, which is most of that
    of both.

    Args:
      learners: policy and value before.
      statistics: of the observations.
      unrolls: [unrolls, time + 1, ...] of this device.
      order: which unrolls each update learns from.
      key: of this device, for the entropy, which is estimated by a sample.
      how: what is the same for all of a run.
    """
    rows = unrolls.packed()
    keys = jax.random.split(key, len(order))

    def minibatch(chosen: Array) -> Unrolls:
        return unrolls.unpacked(rows[chosen])

    return (_staggered if how.staggered else _at_once)(learners, statistics, minibatch, order, keys, how)


def _at_once(
    learners: TrainStates,
    statistics: RunningStatisticsState,
    minibatch: Callable[[Array], Unrolls],
    order: Array,
    keys: Array,
    how: UpdateConfig,
) -> tuple[TrainStates, Array]:
    def update(learners: TrainStates, inputs: tuple[Array, Array]) -> tuple[TrainStates, Array]:
        policy, value = learners
        chosen, key = inputs
        seen = minibatch(chosen)
        value_gradient, error, advantages = _value_gradient(value, statistics, seen, how)
        policy_gradient, metrics = _policy_gradient(policy, statistics, seen, advantages, key, how)
        mean = jax.lax.pmean(jnp.concatenate([policy_gradient, value_gradient]), how.axis)
        policy_mean, value_mean = mean[: len(policy_gradient)], mean[len(policy_gradient) :]
        policy, value = _step(policy, policy_mean, _norm(mean), how), _step(value, value_mean, _norm(value_mean), how)
        return (policy, value), jnp.append(error, metrics)

    learners, metrics = jax.lax.scan(update, learners, (order, keys), unroll=how.unroll)
    return learners, metrics.mean(axis=0)


def _staggered(
    learners: TrainStates,
    statistics: RunningStatisticsState,
    minibatch: Callable[[Array], Unrolls],
    order: Array,
    keys: Array,
    how: UpdateConfig,
) -> tuple[TrainStates, Array]:
    # NCCL must not be given two messages at once: each has the norm in it that comes of the one before.
    def update(carry: tuple[TrainState, TrainState, Array], inputs: tuple[Array, Array, Array]) -> Any:
        policy, value, message = carry
        chosen, key, first = inputs
        seen = minibatch(chosen)
        stepped, norm = policy_step(policy, message)
        policy = jax.tree.map(lambda old, new: jnp.where(first, old, new), policy, stepped)
        policy = jax.lax.optimization_barrier(policy)  # else XLA copies the message before it sends it
        gradient, error, advantages = _value_gradient(value, statistics, seen, how)
        advantages += 0 * gradient[0]  # after the gradient: beside its message the policy's is computed
        mean = jax.lax.pmean(jnp.append(gradient, norm), how.axis)[:-1]
        value_norm = _norm(mean)
        gradient, metrics = _policy_gradient(policy, statistics, seen, advantages, key, how)
        message = jnp.append(gradient, value_norm)
        return (policy, _step(value, mean, value_norm, how), message), jnp.append(error, metrics)

    def policy_step(policy: TrainState, message: Array) -> tuple[TrainState, Array]:
        mean = jax.lax.pmean(message, how.axis)
        norm = _norm(mean[:-1])
        return _step(policy, mean[:-1], jnp.hypot(norm, mean[-1]), how), norm

    none = 0 * ravel_pytree(learners[0].params)[0]
    after = 0 * ravel_pytree(statistics.mean)[0].sum()  # the statistics were sent before
    nothing = jnp.append(none, after.astype(none.dtype))
    first = jnp.arange(len(order)) == 0
    (policy, value, message), metrics = jax.lax.scan(
        update, (*learners, nothing), (order, keys, first), unroll=how.unroll
    )
    policy, norm = policy_step(policy, message)
    return (policy, value), metrics.mean(axis=0) + 0 * norm  # they may be sent next


def _value_gradient(
    value: TrainState, statistics: RunningStatisticsState, seen: Unrolls, how: UpdateConfig
) -> tuple[Array, Array, Array]:
    differentiated = jax.value_and_grad(value_loss, has_aux=True)
    (error, advantages), gradients = differentiated(value.params, statistics, seen, how.networks, how.config)
    return ravel_pytree(gradients)[0], error, advantages


def _policy_gradient(
    policy: TrainState,
    statistics: RunningStatisticsState,
    seen: Unrolls,
    advantages: Array,
    key: Array,
    how: UpdateConfig,
) -> tuple[Array, Array]:
    differentiated = jax.grad(policy_loss, has_aux=True)
    gradients, metrics = differentiated(policy.params, statistics, seen, advantages, key, how.networks, how.config)
    return ravel_pytree(gradients)[0], metrics


def _step(learner: TrainState, gradient: Array, norm: Array, how: UpdateConfig) -> TrainState:
    clipped = gradient * jnp.minimum(1, how.config.max_grad_norm / norm)
    change, state = how.optimizer.update(clipped, learner.optimizer)
    unravel = ravel_pytree(learner.params)[1]
    return TrainState(optax.apply_updates(learner.params, unravel(change)), state)


def _norm(vector: Array) -> Array:
    return jnp.sqrt(jnp.sum(jnp.square(vector)))
