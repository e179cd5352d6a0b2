"""PPO on an imitation environment, from the networks to the training loop (Schulman et al., 2017).

Networks, running statistics and action distribution are brax's. Brax's own loop compiles its functions one after the
other. Here `start` and `epoch` are functions over all devices whose shapes are known in advance, so that both compile
in parallel, and in parallel with imports and with the evaluation's functions.
"""

import dataclasses
import functools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import State, Wrapper
from brax.training import networks as brax_networks
from brax.training.acme import running_statistics, specs
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import networks as ppo_networks
from flax import struct
from jax.experimental import multihost_utils
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int

from mimic.arms.arrays import MAX_JOINTS
from mimic.base.compilation import Background, a_process_for_each_gpu, compiler_options, in_background
from mimic.envs.imitation import ImitationEnv, arm_state
from mimic.envs.many_arms_observation import JOINT_FEATURES
from mimic.envs.wrappers import fresh_episodes
from mimic.evaluation.evaluator import Controller
from mimic.metric.kinematics import LinkStates
from mimic.runs.checkpoints import (
    STATE_UNUSED,
    Checkpoint,
    checkpoint_steps,
    save_checkpoint,
    thin_checkpoints,
)
from mimic.runs.divergence import check_finite
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOConfig
from mimic.trainers.networks import JointPolicy
from mimic.trainers.schedules import schedules_from
from mimic.trainers.trainer import OnEvaluation

Params = tuple[Any, Any, Any]  # observation statistics, policy parameters, value parameters
Metrics = dict[str, Array]

POLICY_METRICS = ("policy_loss", "entropy", "approx_kl", "clip_fraction", "action_std")
METRICS = ("value_loss", *POLICY_METRICS)
_VALUE_WEIGHT = 0.25  # of the squared value error in the loss
_UNROLLED_STEPS = 32  # steps of the advantage estimate in one kernel
_ALIGNED = 8  # entries; matrix products of GPUs are up to 14 % slower on inputs of other widths
_MIN_DEVIATION, _MAX_NORMALIZED = 0.1, 10.0  # of an observation of any arm, whose entries are of the order of 1
_AXIS = "devices"
_REPLICATED, _SHARDED = PartitionSpec(), PartitionSpec(_AXIS)


def make_networks(
    config: PPOConfig, observation_size: int, action_size: int, privileged_size: int
) -> ppo_networks.PPONetworks:
    """The policy and value network of the trainer's settings.

    Args:
      config: the settings.
      observation_size: length of an observation.
      action_size: length of an action.
      privileged_size: length of `ImitationEnv.privileged`, which a privileged critic observes too.
    """
    hidden = tuple(config.hidden_layers or ())
    layers = {"policy_hidden_layer_sizes": hidden, "value_hidden_layer_sizes": hidden}
    make = functools.partial(ppo_networks.make_ppo_networks, action_size=action_size, **layers)
    normalize = _normalize_bounded if config.network == "joints" else running_statistics.normalize
    networks = make(observation_size, preprocess_observations_fn=lambda *inputs: _aligned(normalize(*inputs), -1))
    if config.privileged_critic:

        def normalize_observation(inputs: Array, statistics: RunningStatisticsState) -> Array:
            observation, privileged = jnp.split(inputs, [observation_size], axis=-1)
            return _aligned(jnp.concatenate([normalize(observation, statistics), privileged], axis=-1), -1)

        critic = make(observation_size + privileged_size, preprocess_observations_fn=normalize_observation)
        networks = dataclasses.replace(networks, value_network=critic.value_network)
    policy, value = _with_aligned_input(networks.policy_network), _with_aligned_input(networks.value_network)
    policy = _joint_policy(observation_size) if config.network == "joints" else policy
    return dataclasses.replace(networks, policy_network=policy, value_network=value)


def _with_aligned_input(network: brax_networks.FeedForwardNetwork) -> brax_networks.FeedForwardNetwork:
    """A network on inputs that are padded by `_aligned`; the shapes of its parameters are those without padding."""

    def apply(statistics: Any, params: Any, observation: Array) -> Any:
        layers = params["params"]
        first = {**layers["hidden_0"], "kernel": _aligned(layers["hidden_0"]["kernel"], 0)}
        return network.apply(statistics, {**params, "params": {**layers, "hidden_0": first}}, observation)

    return dataclasses.replace(network, apply=apply)


def _aligned(values: Array, axis: int) -> Array:
    """Values with zeros at the end of an axis, so that its length is a multiple of `_ALIGNED` on a GPU."""
    shape = list(values.shape)
    shape[axis] = -shape[axis] % _ALIGNED if jax.default_backend() == "gpu" else 0
    return jnp.concatenate([values, jnp.zeros(shape, values.dtype)], axis) if shape[axis] else values


def _normalize_bounded(observation: Array, statistics: RunningStatisticsState) -> Array:
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


def initial_params(networks: ppo_networks.PPONetworks, observation_size: int, key: Array) -> Params:
    """The parameters of an untrained policy."""
    key_policy, key_value = jax.random.split(key)
    statistics = running_statistics.init_state(specs.Array((observation_size,), jnp.dtype("float32")))
    return statistics, networks.policy_network.init(key_policy), networks.value_network.init(key_value)


def params_template(config: PPOConfig, observation_size: int, action_size: int, privileged_size: int) -> Params:
    """The shapes of the parameters, with the structure of a checkpoint; see `make_networks`."""
    networks = make_networks(config, observation_size, action_size, privileged_size)
    return jax.eval_shape(lambda: initial_params(networks, observation_size, jax.random.PRNGKey(0)))


def make_controller(config: PPOConfig, observation_size: int, action_size: int) -> Callable[[Params], Controller]:
    """The deterministic policy as a function of its parameters."""
    networks = make_networks(config, observation_size, action_size, privileged_size=0)  # the policy has no such input
    make_policy = ppo_networks.make_inference_fn(networks)

    def controller(params: Params) -> Controller:
        policy, unused_key = make_policy(params, deterministic=True), jax.random.PRNGKey(0)
        return lambda state: policy(state.obs, unused_key)[0]

    return controller


class Setup(NamedTuple):
    """What is constant in a training: the compiled functions close over it.

    Attributes:
      env: the environment with its training demonstrations.
      config: the trainer's settings; in an update those of that update, see `PPOConfig.at`.
      networks: policy and value network.
      optimizer: optimizer of both networks.
      progress: fraction of the training that is done after a number of updates.
      devices: number of devices.
      is_staggered: whether the policy takes its step after the value network has started with the next minibatch. The
        all-reduce of each network's gradient is then overlapped with the computation of the other; the result is the
        same. Otherwise both networks take their steps together, after a single all-reduce.
    """

    env: ImitationEnv
    config: PPOConfig
    networks: ppo_networks.PPONetworks
    optimizer: optax.GradientTransformation
    progress: optax.Schedule
    devices: int
    is_staggered: bool

    @property
    def unroll(self) -> int:
        """Updates in each iteration of the compiled loop.

        A GPU pauses between CUDA graphs, and a graph spans at most one iteration of a loop. On one GPU the longer
        compilation takes as much time as this saves.
        """
        return 2 if self.devices > 1 else 1


def make_setup(env: ImitationEnv, config: PPOConfig, devices: int) -> Setup:
    """The setup of a training. Learning rate, entropy cost and discount factor change with its progress."""
    progress = optax.linear_schedule(0.0, 1.0, _updates(config, config.num_timesteps))

    def learning_rate(count: Any) -> Any:
        return config.learning_rate * (1 + progress(count) * (config.final_learning_rate - 1))

    networks = make_networks(config, env.observation_size, env.action_size, env.privileged_size)
    return Setup(env, config, networks, optax.adam(learning_rate), progress, devices, a_process_for_each_gpu())


def _updates(config: PPOConfig, step: int) -> int:
    """Updates of a network in a number of environment steps."""
    return step // config.steps_per_batch * config.num_minibatches * config.num_updates_per_batch


class NetworkState(NamedTuple):
    """The state of the policy network or of the value network.

    Attributes:
      params: parameters of the network.
      optimizer: optax's state for all parameters as one vector, so that a step is one kernel.
    """

    params: Any
    optimizer: optax.OptState


@struct.dataclass
class TrainingState:
    """The state of a training between two epochs.

    Attributes:
      policy: parameters of the policy network, and the state of their optimizer.
      value: parameters of the value network, and the state of their optimizer.
      statistics: running mean and deviation of the observations.
      episodes: states of the environments, distributed over the devices.
      expert_states: of the environment.
      key: random key for exploration and shuffling.
    """

    policy: NetworkState
    value: NetworkState
    statistics: RunningStatisticsState
    episodes: State
    expert_states: LinkStates
    key: Array

    @property
    def params(self) -> Params:
        """The parameters that define a policy, as they are saved."""
        return self.statistics, self.policy.params, self.value.params

    @property
    def saved(self) -> "TrainingState":
        """What a checkpoint holds: the state without what follows from the demonstrations."""
        return dataclasses.replace(self, expert_states=None)


_PARTITIONS = TrainingState(_REPLICATED, _REPLICATED, _REPLICATED, _SHARDED, _REPLICATED, _REPLICATED)  # type: ignore[arg-type]


def start(
    setup: Setup, seed: Int[Array, ""], initial: Params | None, done_updates: Int[Array, ""], expert_states: LinkStates
) -> TrainingState:
    """The state before the first update, on one device; schedules begin after `done_updates`."""
    key_networks, key_episodes, key = jax.random.split(jax.random.PRNGKey(seed), 3)
    statistics, policy, value = initial or initial_params(setup.networks, setup.env.observation_size, key_networks)
    num_envs = setup.config.num_envs // setup.devices
    keys = jax.random.split(jax.random.fold_in(key_episodes, jax.lax.axis_index(_AXIS)), num_envs)
    episodes = fresh_episodes(setup.env.with_expert_states(expert_states)).reset(keys)
    networks = (begin(params, setup.optimizer, done_updates) for params in (policy, value))
    return TrainingState(*networks, statistics, episodes, expert_states, key)  # type: ignore[arg-type]


def begin(params: Any, optimizer: optax.GradientTransformation, done_updates: Any = 0) -> NetworkState:
    """The state of a network before its first update; schedules of the optimizer begin after `done_updates`."""
    state = optimizer.init(ravel_pytree(params)[0])
    return NetworkState(params, schedules_from(state, done_updates))


class Unrolls(NamedTuple):
    """Unrolls: consecutive steps of arms. The last sample in time has the final observation; its other fields are zero.

    Attributes:
      observation: [*unrolls, time + 1, n] before the step.
      raw_action: [*unrolls, time + 1, m] sample of the policy's normal distribution, before the tanh.
      privileged: [*unrolls, time + 1, k] `ImitationEnv.privileged` before the step; the last sample has it too.
      log_prob: [*unrolls, time + 1] log-probability of the action under the policy that took it.
      reward: [*unrolls, time + 1].
      goes_on: [*unrolls, time + 1] 0 where the episode ended with the step, else 1.
    """

    observation: Array
    raw_action: Array
    privileged: Array
    log_prob: Array
    reward: Array
    goes_on: Array

    def packed(self) -> Array:
        """All fields, concatenated along the last axis, so that one kernel gathers a minibatch."""
        return jnp.concatenate([x if x.ndim == self.observation.ndim else x[..., None] for x in self], axis=-1)

    def unpacked(self, rows: Array) -> "Unrolls":
        """The unrolls of any number of rows of `packed`."""
        ends = np.cumsum([x.shape[-1] for x in self[:3]])
        *vectors, rest = jnp.split(rows, ends, axis=-1)
        return Unrolls(*vectors, *jnp.moveaxis(rest, -1, 0))


def collect(setup: Setup, env: Wrapper, state: TrainingState, key: Array) -> tuple[TrainingState, Unrolls]:
    """Steps all arms of a device; returns the state after it and unrolls [time + 1, arms, ...]."""
    policy = ppo_networks.make_inference_fn(setup.networks)(state.params)

    def privileged(episodes: State) -> Array:
        return jax.vmap(setup.env.privileged)(arm_state(episodes))

    def step(episodes: State, key: Array) -> tuple[State, Unrolls]:
        action, extras = policy(episodes.obs, key)
        after = env.step(episodes, action)
        taken = Unrolls(
            episodes.obs,  # type: ignore[arg-type]
            extras["raw_action"],
            privileged(episodes),
            extras["log_prob"],
            after.reward,
            1 - after.done,
        )
        return after, taken

    keys = jax.random.split(key, setup.config.unroll_length)
    episodes, steps = jax.lax.scan(step, state.episodes, keys)
    last = jax.tree.map(lambda x: jnp.zeros_like(x[:1]), steps)
    last = last._replace(observation=episodes.obs[None], privileged=privileged(episodes)[None])
    steps = jax.tree.map(lambda *x: jnp.concatenate(x), steps, last)
    return dataclasses.replace(state, episodes=episodes), steps


# The sum of both losses equals brax's `compute_ppo_loss` for episodes that terminate and are never truncated, as those
# of our environments; only the random sample that estimates the entropy differs. There are two losses because policy
# and value network have no parameter in common. On a GPU a training is many small kernels, so the losses need few of
# them: no loop over a few steps, one pass of the value network, few metrics.


def value_loss(
    params: Any, statistics: RunningStatisticsState, unrolls: Unrolls, setup: Setup
) -> tuple[Array, Float[Array, "unrolls time"]]:
    """The loss of the value network, and the normalised advantages for the policy's loss.

    Args:
      params: parameters of the value network.
      statistics: running statistics of the observations.
      unrolls: [unrolls, time + 1, ...].
      setup: of the training; networks and config are used.
    """
    config, observation = setup.config, unrolls.observation
    if config.privileged_critic:
        observation = jnp.concatenate([observation, unrolls.privileged], axis=-1)
    values = setup.networks.value_network.apply(statistics, params, observation)
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
    setup: Setup,
) -> tuple[Array, Float[Array, " metrics"]]:
    """The loss of the policy network (clipped surrogate and entropy), and the values of `POLICY_METRICS`.

    Args:
      params: parameters of the policy network.
      statistics: running statistics of the observations.
      unrolls: [unrolls, time + 1, ...].
      advantages: from `value_loss`.
      key: for the sampled estimate of the entropy.
      setup: of the training; networks and config are used.
    """
    logits = setup.networks.policy_network.apply(statistics, params, unrolls.observation[:, :-1])
    raw_action, old_log_prob = unrolls.raw_action[:, :-1], unrolls.log_prob[:, :-1]
    actions, config = setup.networks.parametric_action_distribution, setup.config
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


class Batch(NamedTuple):
    """What the networks learn from, on one device.

    Attributes:
      statistics: running statistics of the observations.
      unrolls: [unrolls, time + 1, ...].
      order: [updates, minibatch] indices of the unrolls in the minibatch of each update.
      key: for the sampled estimates of the entropy.
    """

    statistics: RunningStatisticsState
    unrolls: Unrolls
    order: Int[Array, "updates minibatch"]
    key: Array


NetworkStates = tuple[NetworkState, NetworkState]  # policy, value


def update(states: NetworkStates, batch: Batch, setup: Setup) -> tuple[NetworkStates, Float[Array, " metrics"]]:
    """Updates policy and value with each minibatch; returns their states and the means of `METRICS` on this device.

    The policy's gradient is clipped by the joint norm of both gradients, as in brax; the value's gradient by its own
    norm, which is most of the joint norm.
    """
    rows = batch.unrolls.packed()
    keys = jax.random.split(batch.key, len(batch.order))

    def minibatch(indices: Array) -> Unrolls:
        return batch.unrolls.unpacked(rows[indices])

    return (_staggered if setup.is_staggered else _synchronous)(states, batch, minibatch, keys, setup)


def _synchronous(
    states: NetworkStates, batch: Batch, minibatch: Callable[[Array], Unrolls], keys: Array, setup: Setup
) -> tuple[NetworkStates, Array]:
    """Both networks take their steps together, after a single all-reduce."""

    def body(states: NetworkStates, inputs: tuple[Array, Array]) -> tuple[NetworkStates, Array]:
        policy, value = states
        indices, key = inputs
        data = batch.statistics, minibatch(indices)
        value_gradient, error, advantages = _gradient(value_loss, value, *data, setup)
        policy_gradient, _, metrics = _gradient(policy_loss, policy, *data, advantages, key, setup)
        mean = jax.lax.pmean(jnp.concatenate([policy_gradient, value_gradient]), _AXIS)
        policy_mean, value_mean = mean[: len(policy_gradient)], mean[len(policy_gradient) :]
        policy = _step(policy, policy_mean, _norm(mean), setup)
        return (policy, _step(value, value_mean, _norm(value_mean), setup)), jnp.append(error, metrics)

    states, metrics = jax.lax.scan(body, states, (batch.order, keys), unroll=setup.unroll)
    return states, metrics.mean(axis=0)


def _staggered(
    states: NetworkStates, batch: Batch, minibatch: Callable[[Array], Unrolls], keys: Array, setup: Setup
) -> tuple[NetworkStates, Array]:
    """The policy takes its step after the value network has started with the next minibatch.

    NCCL must not run two all-reduces concurrently. So each operand includes a norm that is computed from the result of
    the previous all-reduce.
    """

    def body(carry: tuple[NetworkState, NetworkState, Array], inputs: tuple[Array, Array, Array]) -> Any:
        policy, value, policy_operand = carry
        indices, key, is_first = inputs
        data = batch.statistics, minibatch(indices)
        stepped, norm = policy_step(policy, policy_operand)
        policy = jax.tree.map(lambda old, new: jnp.where(is_first, old, new), policy, stepped)
        policy = jax.lax.optimization_barrier(policy)  # otherwise XLA copies the operand before the all-reduce
        gradient, error, advantages = _gradient(value_loss, value, *data, setup)
        # The policy's gradient comes after the value's, so that it is computed during the all-reduce of the value's.
        advantages += 0 * gradient[0]
        mean = jax.lax.pmean(jnp.append(gradient, norm), _AXIS)[:-1]
        value_norm = _norm(mean)
        gradient, _, metrics = _gradient(policy_loss, policy, *data, advantages, key, setup)
        policy_operand = jnp.append(gradient, value_norm)
        return (policy, _step(value, mean, value_norm, setup), policy_operand), jnp.append(error, metrics)

    def policy_step(policy: NetworkState, operand: Array) -> tuple[NetworkState, Array]:
        mean = jax.lax.pmean(operand, _AXIS)
        norm = _norm(mean[:-1])
        return _step(policy, mean[:-1], jnp.hypot(norm, mean[-1]), setup), norm

    zeros = 0 * ravel_pytree(states[0].params)[0]
    # This orders the first all-reduce after that of the statistics.
    after_statistics = 0 * ravel_pytree(batch.statistics.mean)[0].sum()
    operand = jnp.append(zeros, after_statistics.astype(zeros.dtype))
    is_first = jnp.arange(len(batch.order)) == 0
    inputs = batch.order, keys, is_first
    (policy, value, operand), metrics = jax.lax.scan(body, (*states, operand), inputs, unroll=setup.unroll)
    policy, norm = policy_step(policy, operand)
    return (policy, value), metrics.mean(axis=0) + 0 * norm  # orders an all-reduce of the metrics after the policy's


def _gradient(loss: Callable[..., Any], network: NetworkState, *inputs: Any) -> tuple[Array, Array, Array]:
    """The gradient of a loss as one vector, the loss, and what else it returns."""
    (value, others), gradient = jax.value_and_grad(loss, has_aux=True)(network.params, *inputs)
    return ravel_pytree(gradient)[0], value, others


def _step(state: NetworkState, gradient: Array, norm: Array, setup: Setup) -> NetworkState:
    clipped = gradient * jnp.minimum(1, setup.config.max_grad_norm / norm)
    change, optimizer_state = setup.optimizer.update(clipped, state.optimizer)
    unravel = ravel_pytree(state.params)[1]
    return NetworkState(optax.apply_updates(state.params, unravel(change)), optimizer_state)


def _norm(vector: Array) -> Array:
    return jnp.sqrt(jnp.sum(jnp.square(vector)))


def epoch(setup: Setup, batches: int, state: TrainingState) -> tuple[TrainingState, Metrics]:
    """Collects batches and learns from them, on one device; returns the means of the metrics over all devices."""
    env = fresh_episodes(setup.env.with_expert_states(state.expert_states))

    def batch(state: TrainingState, _: None) -> tuple[TrainingState, Array]:
        return _learn_from_batch(setup, env, state)

    state, metrics = jax.lax.scan(batch, state, None, length=batches)
    means = dict(zip(METRICS, jax.lax.pmean(metrics.mean(axis=0), _AXIS), strict=True))
    entropy_cost = _settings_now(setup, state).entropy_cost
    loss = means["policy_loss"] + means["value_loss"] - entropy_cost * means["entropy"]
    return state, {"loss": loss, **means}


def _learn_from_batch(setup: Setup, env: Wrapper, state: TrainingState) -> tuple[TrainingState, Array]:
    config = setup.config
    rounds = config.batch_size * config.num_minibatches // config.num_envs
    minibatch = config.batch_size // setup.devices
    key, key_unroll, key_order, key_loss = jax.random.split(state.key, 4)
    key_unroll, key_order, key_loss = (
        jax.random.fold_in(k, jax.lax.axis_index(_AXIS)) for k in (key_unroll, key_order, key_loss)
    )
    collect_round = functools.partial(collect, setup, env)
    state, collected = jax.lax.scan(collect_round, state, jax.random.split(key_unroll, rounds))
    unrolls = jax.tree.map(lambda x: jnp.moveaxis(x, 2, 1).reshape(-1, x.shape[1], *x.shape[3:]), collected)
    statistics = running_statistics.update(state.statistics, unrolls.observation[:, :-1], pmap_axis_name=_AXIS)
    passes = jax.random.split(key_order, config.num_updates_per_batch)
    count = len(unrolls.observation)
    order = jax.vmap(lambda key: jax.random.permutation(key, count))(passes).reshape(-1, minibatch)
    now = setup._replace(config=_settings_now(setup, state))
    batch = Batch(statistics, unrolls, order, key_loss)
    (policy, value), metrics = update((state.policy, state.value), batch, now)
    return dataclasses.replace(state, policy=policy, value=value, statistics=statistics, key=key), metrics


def _settings_now(setup: Setup, state: TrainingState) -> PPOConfig:
    """The settings at the present update."""
    return setup.config.at(setup.progress(state.policy.optimizer[1].count))


class TrainingFunctions(NamedTuple):
    """The functions of a training over all devices. Those that compile do so in the background.

    Attributes:
      start: (seed, parameters to start from or None, updates that were done with them) -> state.
      restore: (leaves of `TrainingState.saved`, updates that were done if the schedules are to begin there) -> state;
        None where they do not fit the settings.
      epoch: state -> state after a training epoch, and the means of the training metrics.
    """

    start: Callable[..., TrainingState]
    restore: Callable[..., TrainingState | None]
    epoch: Background[Callable[[TrainingState], tuple[TrainingState, Metrics]]]


def compile_training(
    env: ImitationEnv, config: PPOConfig, batches: int, initial: Params | None = None, *, restored: bool = False
) -> TrainingFunctions:
    """Compiles the functions of a training in the background.

    Args:
      env: the environment with its training demonstrations.
      config: the trainer's settings.
      batches: number of batches in a training epoch.
      initial: parameters to start from, or their shapes; random ones where None.
      restored: whether a saved state is to be restored, so that `start` is not needed.
    """
    mesh = Mesh(np.array(jax.devices()), (_AXIS,))
    setup, expert_states = make_setup(env, config, mesh.size), jax.device_get(env.expert_states)
    begin = _over_devices(mesh, functools.partial(start, setup), (_REPLICATED,) * 4, _PARTITIONS)
    # Without weak types, so that the compiled epoch is that of a restored state.
    shapes = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding),
        jax.eval_shape(begin, 0, initial, 0, expert_states),
    )
    outputs = _PARTITIONS, _REPLICATED
    learn = _over_devices(mesh, functools.partial(epoch, setup, batches), (_PARTITIONS,), outputs, donate_argnums=0)
    compiled_learn = in_background(learn.lower(shapes).compile)  # before the other, because it takes longer
    compiled_start = Background(lambda: begin.lower(0, initial, 0, expert_states).compile())
    if not restored:
        compiled_start.start()

    def start_from(seed: int, params: Params | None = None, done_updates: int = 0) -> TrainingState:
        return compiled_start()(seed, params, done_updates, expert_states)

    return TrainingFunctions(start_from, functools.partial(_restore, mesh, shapes, expert_states), compiled_learn)


def _over_devices(mesh: Mesh, function: Any, inputs: Any, outputs: Any, **options: Any) -> Any:
    """`jax.jit` of a function that runs on each device of the mesh, with partition specs of inputs and outputs."""
    mapped = jax.shard_map(function, mesh=mesh, in_specs=inputs, out_specs=outputs, check_vma=False)
    shardings = [jax.tree.map(lambda spec: NamedSharding(mesh, spec), specs) for specs in (inputs, outputs)]
    return jax.jit(
        mapped, in_shardings=shardings[0], out_shardings=shardings[1], compiler_options=compiler_options(), **options
    )


def _restore(
    mesh: Mesh,
    shapes: TrainingState,
    expert_states: LinkStates,
    leaves: Sequence[np.ndarray],
    done_updates: int | None = None,
) -> TrainingState | None:
    """The state with these leaves, on the devices; None where they do not fit. See `TrainingFunctions`."""
    expected, structure = jax.tree.flatten(shapes.saved)
    if [(x.shape, x.dtype) for x in leaves] != [(x.shape, x.dtype) for x in expected]:
        return None
    state: TrainingState = jax.tree.unflatten(structure, leaves)
    if done_updates is not None:  # the settings of the batches may have changed, and with them the updates so far
        policy, value = (
            network._replace(optimizer=schedules_from(network.optimizer, done_updates))
            for network in (state.policy, state.value)
        )
        state = dataclasses.replace(state, policy=policy, value=value)
    state = dataclasses.replace(state, expert_states=expert_states)
    return jax.device_put(state, jax.tree.map(lambda spec: NamedSharding(mesh, spec), _PARTITIONS))


def saved_leaves(state: TrainingState) -> list[np.ndarray]:
    """The leaves of `TrainingState.saved` on the host, those of all processes."""
    saved = state.saved
    if jax.process_count() > 1:
        saved = dataclasses.replace(saved, episodes=multihost_utils.process_allgather(saved.episodes, tiled=True))
    return jax.tree.leaves(jax.device_get(saved))


# Above 40 lines because of its docstring.
def train(
    env: ImitationEnv,
    config: PPOConfig,
    run_dir: Path,
    *,
    seed: int,
    on_evaluation: OnEvaluation,
    signals: Signals,
    restored: Checkpoint | None = None,
    on_compiling: Callable[[], None] = lambda: None,
) -> tuple[int, Params]:
    """Trains a policy. See `Trainer.train` for the result, the errors and the other arguments.

    Args:
      env: the environment with its training demonstrations.
      config: the trainer's settings.
      run_dir: folder of the checkpoints.
      seed: random seed of networks, exploration and resets.
      on_evaluation: called for the initial parameters, without metrics, and after each training epoch; the metrics are
        those of the losses, environment steps per second (sps) and seconds of training (walltime).
      signals: signals of the process.
      restored: the checkpoint to continue from. With the training's state the result is that of a training that was not
        interrupted; without it, the optimizer and the environments start anew.
      on_compiling: called when the functions of the training start to compile; it may start work in other threads.
    """
    pending: list[Checkpoint] = []
    for checkpoint in _checkpoints(env, config, seed, restored, on_compiling):
        if checkpoint.step not in checkpoint_steps(run_dir):
            save_checkpoint(run_dir, *checkpoint)
            thin_checkpoints(run_dir, config.keep)
        pending.append(checkpoint)
        if checkpoint.metrics:  # the start is evaluated with the first epoch: the evaluation compiles until then
            for each in pending:
                on_evaluation(each.step, each.params, each.metrics)
            pending.clear()
        if checkpoint.step < config.total_steps:  # a finished training is not interrupted: there is nothing to resume
            signals.check()
    return checkpoint.step, checkpoint.params


def follow(env: ImitationEnv, config: PPOConfig, *, seed: int, restored: Checkpoint | None = None) -> None:
    """Runs the same training epochs as the first process, where `train` runs."""
    for _ in _checkpoints(env, config, seed, restored, lambda: None):
        pass


def _checkpoints(
    env: ImitationEnv,
    config: PPOConfig,
    seed: int,
    restored: Checkpoint | None,
    on_compiling: Callable[[], None],
) -> Iterator[Checkpoint]:
    """The checkpoint at the start of a training or the restored one, and that after each training epoch."""
    step, initial, leaves, metrics = restored or Checkpoint(0, None, None, {})
    del restored
    # Batches between two evaluations. A resumed training has the same, and so the same compiled function.
    batches = max(round(-(-config.num_timesteps // config.steps_per_batch) / config.evaluations), 1)
    functions = compile_training(env, config, batches, initial, restored=leaves is not None)
    on_compiling()
    state = None if leaves is None else functions.restore(leaves, _updates(config, step))
    leaves = None  # frees their memory
    if state is None:  # none is saved, or none that fits the settings
        if step and jax.process_index() == 0:
            print(STATE_UNUSED, file=sys.stderr)
        state = functions.start((seed + step) % 2**31, initial, _updates(config, step))  # range of a 32-bit integer
    yield Checkpoint(step, jax.device_get(state.params), saved_leaves(state), metrics)
    walltime = metrics.get("walltime", 0.0)
    while step < config.num_timesteps:
        run_epoch = functions.epoch()
        began = time.perf_counter()
        state, means = run_epoch(state)
        metrics = {name: float(value) for name, value in jax.device_get(means).items()}
        seconds = time.perf_counter() - began
        walltime += seconds
        step += batches * config.steps_per_batch
        params = jax.device_get(state.params)
        check_finite(step, metrics, params)
        speed = {"sps": batches * config.steps_per_batch / seconds, "walltime": walltime}
        yield Checkpoint(step, params, saved_leaves(state), {**speed, **metrics})
