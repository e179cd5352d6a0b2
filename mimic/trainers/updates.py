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
    overlap: bool,
) -> tuple[Learner, Learner, Float[Array, " metrics"]]:
    """Policy and value after an update by each minibatch, and the means of `METRICS` on this device.

    Policy and value have no parameter in common, so that the message that makes a mean of one's gradients can be on its
    way while the other's are computed: the policy takes a step when the value has begun with the next minibatch.
    That changes nothing of what is learned.

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
      overlap: messages with computation. It pays where there is more than one device.
    """
    rows = unrolls.packed()

    def mean(vector: Array, after: Array | None = None) -> Array:
        """Over the devices. It waits for a message before it: NCCL must not be given two at once."""
        if after is None:
            return jax.lax.pmean(vector, axis)
        return jax.lax.pmean(jnp.append(vector, after[0]), axis)[:-1]

    def step(learner: Learner, gradient: Array) -> Learner:
        change, state = optimizer.update(gradient, learner.optimizer)
        unravel = ravel_pytree(learner.params)[1]
        return Learner(optax.apply_updates(learner.params, unravel(change)), state)

    def update(carry: Any, inputs: Any) -> Any:
        policy, value, late = carry
        chosen, key = inputs
        given = statistics, unrolls.unpacked(rows[chosen])
        arrived = None
        if overlap:
            waiting, gradient = late
            arrived = mean(gradient)
            policy = jax.tree.map(lambda new, old: jnp.where(waiting, new, old), step(policy, arrived), policy)
        of_value = jax.value_and_grad(value_loss, has_aux=True)
        (error, advantages), gradients = of_value(value.params, *given, networks, config)
        value = step(value, mean(ravel_pytree(gradients)[0], after=arrived))
        of_policy = jax.grad(policy_loss, has_aux=True)
        gradients, metrics = of_policy(policy.params, *given, advantages, key, networks, config)
        gradient = ravel_pytree(gradients)[0]
        if overlap:
            late = jnp.array(True), gradient
        else:
            policy = step(policy, mean(gradient))
        return (policy, value, late), jnp.append(error, metrics)

    nothing = (jnp.array(False), jnp.zeros_like(ravel_pytree(policy.params)[0])) if overlap else None
    inputs = order, jax.random.split(key, len(order))
    (policy, value, late), metrics = jax.lax.scan(update, (policy, value, nothing), inputs)
    if overlap:
        policy = step(policy, mean(late[1]))  # type: ignore[index]
    return policy, value, metrics.mean(axis=0)
