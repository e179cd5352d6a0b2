"""PPO as two compiled functions over all devices: one starts a training, one runs a training epoch.

Networks, running statistics and action distribution are brax's. Brax's own loop compiles its functions one after the
other. Here their arguments' shapes are known in advance, so that both compile in parallel, and in parallel with imports
and with the evaluation's functions.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import State, Wrapper
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from flax import struct
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from mimic.base.compilation import Background, a_process_for_each_gpu, compiler_options, in_background
from mimic.envs.imitation import ImitationEnv, arm_state
from mimic.envs.wrappers import fresh_episodes
from mimic.metric.kinematics import LinkStates
from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo import updates
from mimic.trainers.ppo.losses import Unrolls
from mimic.trainers.schedules import schedules_from

Params = tuple[Any, Any, Any]  # observation statistics, policy parameters, value parameters
Metrics = dict[str, Array]

_AXIS = "devices"
_REPLICATED, _SHARDED = PartitionSpec(), PartitionSpec(_AXIS)


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

    policy: updates.TrainState
    value: updates.TrainState
    statistics: running_statistics.RunningStatisticsState
    episodes: State
    expert_states: LinkStates
    key: Array

    @property
    def params(self) -> Params:
        """The parameters that define a policy, as they are saved."""
        return self.statistics, self.policy.params, self.value.params

    @property
    def saved(self) -> "TrainingState":
        """The state without what follows from the demonstrations."""
        return dataclasses.replace(self, expert_states=None)


_PARTITIONS = TrainingState(_REPLICATED, _REPLICATED, _REPLICATED, _SHARDED, _REPLICATED, _REPLICATED)  # type: ignore[arg-type]


class TrainingFunctions(NamedTuple):
    """The functions of a training. Those that compile do so in the background.

    Attributes:
      start: (seed, parameters to start from or None, updates that were done with them) -> state.
      restore: (leaves of `TrainingState.saved`, updates that were done if the schedules are to begin there) -> state;
        None where they do not fit the settings.
      epoch: state -> state after a training epoch, and the means of the training metrics.
    """

    start: Callable[..., TrainingState]
    restore: Callable[..., TrainingState | None]
    epoch: Background[Callable[[TrainingState], tuple[TrainingState, Metrics]]]


# Above 40 lines because of its docstring.
def compile_training(
    env: ImitationEnv,
    config: PPOConfig,
    networks: ppo_networks.PPONetworks,
    batches: int,
    learning_rate: optax.Schedule,
    initial: Params | None,
    progress: optax.Schedule = lambda count: 0.0,
    *,
    restored: bool = False,
) -> TrainingFunctions:
    """Compiles the functions of a training in the background.

    Args:
      env: the environment with its training demonstrations.
      config: the trainer's settings.
      networks: policy and value network.
      batches: number of batches in a training epoch.
      learning_rate: Adam's learning rate at each update from 0 on.
      initial: parameters to start from, or their shapes; random ones where None.
      progress: fraction of the training that is done at each update, see `PPOConfig.at`.
      restored: whether a saved state is to be restored, so that `start` is not needed.
    """
    setup = _set_up(env, config, networks, learning_rate, progress, initial)
    epoch = functools.partial(setup.training.epoch, batches)
    learn = _over_devices(setup.mesh, epoch, (_PARTITIONS,), (_PARTITIONS, _REPLICATED), donate_argnums=0)
    compiled_learn = in_background(learn.lower(setup.shapes).compile)  # before the other, because it takes longer
    compiled_start = Background(lambda: setup.start.lower(0, initial, 0, setup.expert_states).compile())
    if not restored:
        compiled_start.start()

    def start_from(seed: int, params: Params | None = None, done_updates: int = 0) -> TrainingState:
        return compiled_start()(seed, params, done_updates, setup.expert_states)

    return TrainingFunctions(start_from, setup.restore, compiled_learn)


def saved_leaves(state: TrainingState) -> list[np.ndarray]:
    """The leaves of `TrainingState.saved` on the host, those of all processes."""
    replicated = jax.device_get(dataclasses.replace(state.saved, episodes=None))
    return jax.tree.leaves(dataclasses.replace(replicated, episodes=of_all_processes(state.episodes)))


def of_all_processes(distributed: Any) -> Any:
    """Arrays that are distributed over the devices, on the host."""
    if jax.process_count() == 1:
        return jax.device_get(distributed)
    return jax.device_get(multihost_utils.process_allgather(distributed, tiled=True))


class _Setup(NamedTuple):
    """What all compiled functions of a training need.

    Attributes:
      training: the training on one device.
      mesh: the devices.
      start: see `_Training.start`, over all devices.
      shapes: those of the state.
      expert_states: of the environment, on the host.
    """

    training: "_Training"
    mesh: Mesh
    start: Any
    shapes: TrainingState
    expert_states: LinkStates

    def restore(self, leaves: Sequence[np.ndarray], done_updates: int | None = None) -> TrainingState | None:
        """The state with these leaves, on the devices; None where they do not fit. See `TrainingFunctions`."""
        expected, structure = jax.tree.flatten(self.shapes.saved)
        if [(x.shape, x.dtype) for x in leaves] != [(x.shape, x.dtype) for x in expected]:
            return None
        state: TrainingState = jax.tree.unflatten(structure, leaves)
        if done_updates is not None:  # the settings of the batches may have changed, and with them the updates so far
            policy, value = (
                network._replace(optimizer=schedules_from(network.optimizer, done_updates))
                for network in (state.policy, state.value)
            )
            state = dataclasses.replace(state, policy=policy, value=value)
        state = dataclasses.replace(state, expert_states=self.expert_states)
        shardings = jax.tree.map(lambda spec: NamedSharding(self.mesh, spec), _PARTITIONS)
        return jax.device_put(state, shardings)


def _set_up(
    env: ImitationEnv,
    config: PPOConfig,
    networks: ppo_networks.PPONetworks,
    learning_rate: optax.Schedule,
    progress: optax.Schedule,
    initial: Params | None,
) -> _Setup:
    mesh = Mesh(np.array(jax.devices()), (_AXIS,))
    training = _Training(env, config, networks, optax.adam(learning_rate), progress, mesh.size)
    start = _over_devices(mesh, training.start, (_REPLICATED,) * 4, _PARTITIONS)
    expert_states = jax.device_get(env.expert_states)
    # Without weak types, so that the compiled epoch is that of a restored state.
    shapes = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding),
        jax.eval_shape(start, 0, initial, 0, expert_states),
    )
    return _Setup(training, mesh, start, shapes, expert_states)


def _over_devices(mesh: Mesh, function: Any, inputs: Any, outputs: Any, **options: Any) -> Any:
    """`jax.jit` of a function that runs on each device of the mesh, with partition specs of inputs and outputs."""
    mapped = jax.shard_map(function, mesh=mesh, in_specs=inputs, out_specs=outputs, check_vma=False)
    shardings = [jax.tree.map(lambda spec: NamedSharding(mesh, spec), specs) for specs in (inputs, outputs)]
    return jax.jit(
        mapped, in_shardings=shardings[0], out_shardings=shardings[1], compiler_options=compiler_options(), **options
    )


def initial_params(networks: ppo_networks.PPONetworks, observation_size: int, key: Array) -> Params:
    """The parameters of an untrained policy."""
    key_policy, key_value = jax.random.split(key)
    statistics = running_statistics.init_state(specs.Array((observation_size,), jnp.dtype("float32")))
    return statistics, networks.policy_network.init(key_policy), networks.value_network.init(key_value)


class _Training(NamedTuple):
    """A training as pure functions on one device; `devices` is the number of devices."""

    env: ImitationEnv
    config: PPOConfig
    networks: ppo_networks.PPONetworks
    optimizer: optax.GradientTransformation
    progress: optax.Schedule
    devices: int

    def start(
        self, seed: Int[Array, ""], initial: Params | None, done_updates: Int[Array, ""], expert_states: LinkStates
    ) -> TrainingState:
        """The state before the first update."""
        key_networks, key_episodes, key = jax.random.split(jax.random.PRNGKey(seed), 3)
        statistics, policy, value = initial or initial_params(self.networks, self.env.observation_size, key_networks)
        num_envs = self.config.num_envs // self.devices
        keys = jax.random.split(jax.random.fold_in(key_episodes, jax.lax.axis_index(_AXIS)), num_envs)
        episodes = fresh_episodes(self.env.with_expert_states(expert_states)).reset(keys)
        states = (updates.begin(params, self.optimizer, done_updates) for params in (policy, value))
        return TrainingState(*states, statistics, episodes, expert_states, key)  # type: ignore[arg-type]

    def epoch(self, batches: int, state: TrainingState) -> tuple[TrainingState, Metrics]:
        """Collects batches and learns from them; returns the means of the metrics."""
        env = fresh_episodes(self.env.with_expert_states(state.expert_states))
        make_policy = ppo_networks.make_inference_fn(self.networks)

        def unroll(state: TrainingState, key: Array) -> tuple[TrainingState, Unrolls]:
            return self._unroll(env, make_policy(state.params), state, key)

        def batch(state: TrainingState, _: None) -> tuple[TrainingState, Array]:
            return self._batch(unroll, state)

        state, metrics = jax.lax.scan(batch, state, None, length=batches)
        means = dict(zip(updates.METRICS, jax.lax.pmean(metrics.mean(axis=0), _AXIS), strict=True))
        entropy_cost = self._settings_now(state).entropy_cost
        loss = means["policy_loss"] + means["value_loss"] - entropy_cost * means["entropy"]
        return state, {"loss": loss, **means}

    def _unroll(self, env: Wrapper, policy: Any, state: TrainingState, key: Array) -> tuple[TrainingState, Unrolls]:
        """The state after an unroll, and the steps of all arms, [time + 1, arms, ...]."""

        def elapsed(episodes: State) -> Array:
            return arm_state(episodes).step / self.env.config.horizon

        def step(episodes: State, key: Array) -> tuple[State, Unrolls]:
            action, extras = policy(episodes.obs, key)
            after = env.step(episodes, action)
            taken = Unrolls(
                episodes.obs,  # type: ignore[arg-type]
                extras["raw_action"],
                extras["log_prob"],
                after.reward,
                1 - after.done,
                elapsed(episodes),
            )
            return after, taken

        keys = jax.random.split(key, self.config.unroll_length)
        episodes, steps = jax.lax.scan(step, state.episodes, keys)
        last = jax.tree.map(lambda x: jnp.zeros_like(x[:1]), steps)
        last = last._replace(observation=episodes.obs[None], elapsed=elapsed(episodes)[None])
        steps = jax.tree.map(lambda *x: jnp.concatenate(x), steps, last)
        return dataclasses.replace(state, episodes=episodes), steps

    def _batch(self, unroll: Callable[..., Any], state: TrainingState) -> tuple[TrainingState, Array]:
        """Collects unrolls, and learns from them; returns the state and the means of the updates' metrics."""
        config = self.config
        rounds = config.batch_size * config.num_minibatches // config.num_envs
        minibatch = config.batch_size // self.devices
        key, key_unroll, key_order, key_loss = jax.random.split(state.key, 4)
        key_unroll, key_order, key_loss = (
            jax.random.fold_in(k, jax.lax.axis_index(_AXIS)) for k in (key_unroll, key_order, key_loss)
        )
        state, collected = jax.lax.scan(unroll, state, jax.random.split(key_unroll, rounds))
        unrolls = jax.tree.map(lambda x: jnp.moveaxis(x, 2, 1).reshape(-1, x.shape[1], *x.shape[3:]), collected)
        statistics = running_statistics.update(state.statistics, unrolls.observation[:, :-1], pmap_axis_name=_AXIS)
        passes = jax.random.split(key_order, config.num_updates_per_batch)
        count = len(unrolls.observation)
        order = jax.vmap(lambda key: jax.random.permutation(key, count))(passes).reshape(-1, minibatch)
        update_config = updates.UpdateConfig(
            self.networks,
            self._settings_now(state),
            self.optimizer,
            axis=_AXIS,
            staggered=a_process_for_each_gpu(),
            # A GPU pauses between CUDA graphs, and a graph spans at most one iteration of a loop. On one GPU the longer
            # compilation takes as much time as this saves.
            unroll=2 if self.devices > 1 else 1,
        )
        states = state.policy, state.value
        (policy, value), metrics = updates.updated(states, statistics, unrolls, order, key_loss, update_config)
        state = dataclasses.replace(state, policy=policy, value=value, statistics=statistics, key=key)
        return state, metrics

    def _settings_now(self, state: TrainingState) -> PPOConfig:
        """The settings at the present update."""
        return self.config.at(self.progress(state.policy.optimizer[1].count))
