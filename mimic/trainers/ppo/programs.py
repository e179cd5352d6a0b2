"""PPO as two programs, one that begins and one that collects and learns, on all devices at once.

Networks, running statistics and action distribution are brax's. Brax's own loop compiles its programs one after
the other, each before it knows of the next; here all that they need is known from shapes, so that they compile side by
side, with whatever else there is to compile or to import.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import State
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from mimic.compilation import Background, a_process_for_each_gpu, compiler_options
from mimic.envs.imitation import ImitationEnv
from mimic.envs.wrappers import fresh_episodes
from mimic.metric.kinematics import LinkStates
from mimic.trainers.config import PPOSettings
from mimic.trainers.ppo import updates
from mimic.trainers.ppo.losses import Unrolls

Params = tuple[Any, Any, Any]  # observation statistics, policy parameters, value parameters
Metrics = dict[str, Array]

_AXIS = "devices"


@struct.dataclass
class TrainingState:
    """What goes from one call of the program that learns to the next.

    Attributes:
      policy: its parameters, and the state of their optimizer.
      value: its parameters, and the state of their optimizer.
      statistics: running mean and deviation of the observations.
      episodes: of the environments, shared out among the devices.
      expert_states: of the environment.
      key: for exploration and shuffling.
    """

    policy: updates.TrainState
    value: updates.TrainState
    statistics: running_statistics.RunningStatisticsState
    episodes: State
    expert_states: LinkStates
    key: Array

    @property
    def params(self) -> Params:
        """What a policy is made of, and what is saved."""
        return self.statistics, self.policy.params, self.value.params


def make_programs(
    env: ImitationEnv,
    config: PPOSettings,
    networks: ppo_networks.PPONetworks,
    batches: int,
    learning_rate: optax.Schedule,
    restored: Params | None,
) -> tuple[
    Background[Callable[[int], TrainingState]], Background[Callable[[TrainingState], tuple[TrainingState, Metrics]]]
]:
    """The programs of a training, being compiled in the background.

    Args:
      env: the environment with its training demonstrations.
      config: resolved.
      networks: of the config.
      batches: that one call of the second program collects and learns from.
      learning_rate: of Adam, at each update from 0 on.
      restored: parameters to go on from.

    Returns:
      What begins, of a seed; and what learns, which gives the means of the loss's metrics too.
    """
    mesh = Mesh(np.array(jax.devices()), (_AXIS,))
    optimizer = optax.adam(learning_rate)
    same, shared = PartitionSpec(), PartitionSpec(_AXIS)
    learning = TrainingState(same, same, same, shared, same, same)  # type: ignore[arg-type]

    def program(function: Any, inputs: Any, outputs: Any, **how: Any) -> Any:
        spread = jax.shard_map(function, mesh=mesh, in_specs=inputs, out_specs=outputs, check_vma=False)
        placed = [jax.tree.map(lambda spec: NamedSharding(mesh, spec), specs) for specs in (inputs, outputs)]
        return jax.jit(
            spread, in_shardings=placed[0], out_shardings=placed[1], compiler_options=compiler_options(), **how
        )

    training = env, config, networks, optimizer, mesh.size
    begin = program(functools.partial(_begin, *training), (same, same, same), learning)
    learn = program(functools.partial(_learn, *training, batches), (learning,), (learning, same), donate_argnums=0)
    expert_states = jax.device_get(env.expert_states)
    start = jax.eval_shape(begin, 0, restored, expert_states)
    lowered = learn.lower(start)
    learns = Background(lowered.compile)
    learns.start()

    def compile_begin() -> Callable[[int], TrainingState]:
        compiled = begin.lower(0, restored, expert_states).compile()
        return lambda seed: compiled(seed, restored, expert_states)

    begins = Background(compile_begin)
    begins.start()
    return begins, learns


def initial_params(networks: ppo_networks.PPONetworks, observation_size: int, key: Array) -> Params:
    """What an untrained policy is made of."""
    key_policy, key_value = jax.random.split(key)
    statistics = running_statistics.init_state(specs.Array((observation_size,), jnp.dtype("float32")))
    return statistics, networks.policy_network.init(key_policy), networks.value_network.init(key_value)


def _begin(
    env: ImitationEnv,
    config: PPOSettings,
    networks: ppo_networks.PPONetworks,
    optimizer: optax.GradientTransformation,
    devices: int,
    seed: Int[Array, ""],
    restored: Params | None,
    expert_states: LinkStates,
) -> TrainingState:
    key_networks, key_episodes, key = jax.random.split(jax.random.PRNGKey(seed), 3)
    statistics, policy, value = restored or initial_params(networks, env.observation_size, key_networks)
    keys = jax.random.split(jax.random.fold_in(key_episodes, jax.lax.axis_index(_AXIS)), config.num_envs // devices)
    episodes = fresh_episodes(env.with_expert_states(expert_states)).reset(keys)
    learners = updates.begin(policy, optimizer), updates.begin(value, optimizer)
    return TrainingState(*learners, statistics, episodes, expert_states, key)  # type: ignore[arg-type]


def _learn(
    env: ImitationEnv,
    config: PPOSettings,
    networks: ppo_networks.PPONetworks,
    optimizer: optax.GradientTransformation,
    devices: int,
    batches: int,
    learning: TrainingState,
) -> tuple[TrainingState, Metrics]:
    episodes_env = fresh_episodes(env.with_expert_states(learning.expert_states))
    make_policy = ppo_networks.make_inference_fn(networks)
    rounds = config.batch_size * config.num_minibatches // config.num_envs
    minibatch = config.batch_size // devices
    # A GPU pauses between CUDA graphs, and none goes beyond a pass of a loop. On one GPU compiling takes what it saves.
    updates_in_a_pass = 2 if devices > 1 else 1
    how = updates.UpdateConfig(
        networks, config, optimizer, axis=_AXIS, staggered=a_process_for_each_gpu(), unroll=updates_in_a_pass
    )

    def unroll(learning: TrainingState, key: Array) -> tuple[TrainingState, Unrolls]:
        """Steps of all arms, [time + 1, arms, ...]."""
        policy = make_policy(learning.params)

        def step(state: State, key: Array) -> tuple[State, Unrolls]:
            action, taken = policy(state.obs, key)
            after = episodes_env.step(state, action)
            return after, Unrolls(state.obs, taken["raw_action"], taken["log_prob"], after.reward, 1 - after.done)  # type: ignore[arg-type]

        keys = jax.random.split(key, config.unroll_length)
        episodes, steps = jax.lax.scan(step, learning.episodes, keys)
        last = jax.tree.map(lambda x: jnp.zeros_like(x[:1]), steps)._replace(observation=episodes.obs[None])
        steps = jax.tree.map(lambda *x: jnp.concatenate(x), steps, last)
        return dataclasses.replace(learning, episodes=episodes), steps

    def batch(learning: TrainingState, _: None) -> tuple[TrainingState, Array]:
        """Collects unrolls, and learns from them."""
        key, key_unroll, key_order, key_loss = jax.random.split(learning.key, 4)
        key_unroll, key_order, key_loss = (
            jax.random.fold_in(k, jax.lax.axis_index(_AXIS)) for k in (key_unroll, key_order, key_loss)
        )
        learning, collected = jax.lax.scan(unroll, learning, jax.random.split(key_unroll, rounds))
        unrolls = jax.tree.map(lambda x: jnp.moveaxis(x, 2, 1).reshape(-1, x.shape[1], *x.shape[3:]), collected)
        statistics = running_statistics.update(learning.statistics, unrolls.observation[:, :-1], pmap_axis_name=_AXIS)
        passes = jax.random.split(key_order, config.num_updates_per_batch)
        count = len(unrolls.observation)
        order = jax.vmap(lambda key: jax.random.permutation(key, count))(passes).reshape(-1, minibatch)
        learners = learning.policy, learning.value
        (policy, value), metrics = updates.updated(learners, statistics, unrolls, order, key_loss, how)
        learning = dataclasses.replace(learning, policy=policy, value=value, statistics=statistics, key=key)
        return learning, metrics

    learning, metrics = jax.lax.scan(batch, learning, None, length=batches)
    means = dict(zip(updates.METRICS, jax.lax.pmean(metrics.mean(axis=0), _AXIS), strict=True))
    loss = means["policy_loss"] + means["value_loss"] - config.entropy_cost * means["entropy"]
    return learning, {"loss": loss, **means}
