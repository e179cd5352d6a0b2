"""PPO's updates of the policy and value networks from unrolls, over all devices."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import networks as ppo_networks
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo.losses import METRICS as POLICY_METRICS
from mimic.trainers.ppo.losses import Unrolls, policy_loss, value_loss
from mimic.trainers.schedules import schedules_from

METRICS = ("value_loss", *POLICY_METRICS)


class TrainState(NamedTuple):
    """The state of the policy network or of the value network.

    Attributes:
      params: parameters of the network.
      optimizer: optax's state for all parameters as one vector, so that a step is one kernel.
    """

    params: Any
    optimizer: optax.OptState


TrainStates = tuple[TrainState, TrainState]  # policy, value


def begin(params: Any, optimizer: optax.GradientTransformation, done_updates: Any = 0) -> TrainState:
    """The state of a network before its first update; schedules of the optimizer begin after `done_updates`."""
    state = optimizer.init(ravel_pytree(params)[0])
    return TrainState(params, schedules_from(state, done_updates))


class UpdateConfig(NamedTuple):
    """The settings of an update.

    Attributes:
      networks: policy and value network.
      settings: the trainer's settings.
      optimizer: optimizer of both networks.
      axis: name of the axis over the devices.
      staggered: whether the policy takes its step after the value network has started with the next minibatch. The
        all-reduce of each network's gradient is then overlapped with the computation of the other; the result is the
        same. Otherwise both networks take their steps together, after a single all-reduce.
      unroll: updates in each iteration of the compiled loop.
    """

    networks: ppo_networks.PPONetworks
    settings: PPOConfig
    optimizer: optax.GradientTransformation
    axis: str
    staggered: bool
    unroll: int


def updated(
    states: TrainStates,
    statistics: RunningStatisticsState,
    unrolls: Unrolls,
    order: Int[Array, "updates minibatch"],
    key: Array,
    config: UpdateConfig,
) -> tuple[TrainStates, Float[Array, " metrics"]]:
    """Updates policy and value with each minibatch; returns their states and the means of `METRICS` on this device.

    The policy's gradient is clipped by the joint norm of both gradients, as in brax; the value's gradient by its own
    norm, which is most of the joint norm.

    Args:
      states: states of policy and value before the updates.
      statistics: running statistics of the observations.
      unrolls: [unrolls, time + 1, ...] of this device.
      order: indices of the unrolls in the minibatch of each update.
      key: of this device, for the sampled estimate of the entropy.
      config: settings of an update.
    """
    rows = unrolls.packed()
    keys = jax.random.split(key, len(order))

    def minibatch(indices: Array) -> Unrolls:
        return unrolls.unpacked(rows[indices])

    return (_staggered if config.staggered else _synchronous)(states, statistics, minibatch, order, keys, config)


def _synchronous(
    states: TrainStates,
    statistics: RunningStatisticsState,
    minibatch: Callable[[Array], Unrolls],
    order: Array,
    keys: Array,
    config: UpdateConfig,
) -> tuple[TrainStates, Array]:
    def update(states: TrainStates, inputs: tuple[Array, Array]) -> tuple[TrainStates, Array]:
        indices, key = inputs
        return _update(states, statistics, minibatch(indices), key, config)

    states, metrics = jax.lax.scan(update, states, (order, keys), unroll=config.unroll)
    return states, metrics.mean(axis=0)


def _update(
    states: TrainStates, statistics: RunningStatisticsState, batch: Unrolls, key: Array, config: UpdateConfig
) -> tuple[TrainStates, Array]:
    """The states after an update with a minibatch, and the metrics."""
    policy, value = states
    value_gradient, error, advantages = _value_gradient(value, statistics, batch, config)
    policy_gradient, metrics = _policy_gradient(policy, statistics, batch, advantages, key, config)
    mean = jax.lax.pmean(jnp.concatenate([policy_gradient, value_gradient]), config.axis)
    policy_mean, value_mean = mean[: len(policy_gradient)], mean[len(policy_gradient) :]
    policy = _step(policy, policy_mean, _norm(mean), config)
    value = _step(value, value_mean, _norm(value_mean), config)
    return (policy, value), jnp.append(error, metrics)


def _staggered(
    states: TrainStates,
    statistics: RunningStatisticsState,
    minibatch: Callable[[Array], Unrolls],
    order: Array,
    keys: Array,
    config: UpdateConfig,
) -> tuple[TrainStates, Array]:
    # NCCL must not run two all-reduces concurrently. So each operand includes a norm that is computed from the result
    # of the previous all-reduce.
    def update(carry: tuple[TrainState, TrainState, Array], inputs: tuple[Array, Array, Array]) -> Any:
        policy, value, policy_operand = carry
        indices, key, first = inputs
        batch = minibatch(indices)
        stepped, norm = policy_step(policy, policy_operand)
        policy = jax.tree.map(lambda old, new: jnp.where(first, old, new), policy, stepped)
        policy = jax.lax.optimization_barrier(policy)  # otherwise XLA copies the operand before the all-reduce
        gradient, error, advantages = _value_gradient(value, statistics, batch, config)
        # The policy's gradient comes after the value's, so that it is computed during the all-reduce of the value's.
        advantages += 0 * gradient[0]
        mean = jax.lax.pmean(jnp.append(gradient, norm), config.axis)[:-1]
        value_norm = _norm(mean)
        gradient, metrics = _policy_gradient(policy, statistics, batch, advantages, key, config)
        policy_operand = jnp.append(gradient, value_norm)
        return (policy, _step(value, mean, value_norm, config), policy_operand), jnp.append(error, metrics)

    def policy_step(policy: TrainState, operand: Array) -> tuple[TrainState, Array]:
        mean = jax.lax.pmean(operand, config.axis)
        norm = _norm(mean[:-1])
        return _step(policy, mean[:-1], jnp.hypot(norm, mean[-1]), config), norm

    zeros = 0 * ravel_pytree(states[0].params)[0]
    after_statistics = 0 * ravel_pytree(statistics.mean)[0].sum()  # orders the first all-reduce after the statistics'
    start = jnp.append(zeros, after_statistics.astype(zeros.dtype))
    first = jnp.arange(len(order)) == 0
    (policy, value, policy_operand), metrics = jax.lax.scan(
        update, (*states, start), (order, keys, first), unroll=config.unroll
    )
    policy, norm = policy_step(policy, policy_operand)
    return (policy, value), metrics.mean(axis=0) + 0 * norm  # orders an all-reduce of the metrics after the policy's


def _value_gradient(
    value: TrainState, statistics: RunningStatisticsState, batch: Unrolls, config: UpdateConfig
) -> tuple[Array, Array, Array]:
    differentiated = jax.value_and_grad(value_loss, has_aux=True)
    (error, advantages), gradients = differentiated(value.params, statistics, batch, config.networks, config.settings)
    return ravel_pytree(gradients)[0], error, advantages


def _policy_gradient(
    policy: TrainState,
    statistics: RunningStatisticsState,
    batch: Unrolls,
    advantages: Array,
    key: Array,
    config: UpdateConfig,
) -> tuple[Array, Array]:
    differentiated = jax.grad(policy_loss, has_aux=True)
    inputs = statistics, batch, advantages, key
    gradients, metrics = differentiated(policy.params, *inputs, config.networks, config.settings)
    return ravel_pytree(gradients)[0], metrics


def _step(state: TrainState, gradient: Array, norm: Array, config: UpdateConfig) -> TrainState:
    clipped = gradient * jnp.minimum(1, config.settings.max_grad_norm / norm)
    change, optimizer_state = config.optimizer.update(clipped, state.optimizer)
    unravel = ravel_pytree(state.params)[1]
    return TrainState(optax.apply_updates(state.params, unravel(change)), optimizer_state)


def _norm(vector: Array) -> Array:
    return jnp.sqrt(jnp.sum(jnp.square(vector)))
