"""PPO on an imitation environment: networks, training epochs, checkpoints."""

import functools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from brax.training.agents.ppo import networks as ppo_networks
from jaxtyping import Array

from mimic.envs.imitation import ImitationEnv
from mimic.evaluation.evaluator import Controller
from mimic.runs.checkpoints import save_checkpoint
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOSettings
from mimic.trainers.ppo.programs import Params, compile_training, initial_params
from mimic.trainers.trainer import OnEvaluation


def make_networks(config: PPOSettings, observation_size: int, action_size: int) -> ppo_networks.PPONetworks:
    """The policy and value network of the trainer's settings."""
    hidden = tuple(config.hidden_layers or ())
    layers = {"policy_hidden_layer_sizes": hidden, "value_hidden_layer_sizes": hidden}
    make = functools.partial(ppo_networks.make_ppo_networks, action_size=action_size, **layers)
    networks = make(observation_size, preprocess_observations_fn=running_statistics.normalize)
    if not config.timed_critic:
        return networks
    timed = make(observation_size + 1, preprocess_observations_fn=_normalize_all_but_last)
    return networks.replace(value_network=timed.value_network)  # type: ignore[attr-defined]


def _normalize_all_but_last(observation: Array, statistics: running_statistics.RunningStatisticsState) -> Array:
    """The observation with normalised entries, except the last one: the elapsed fraction of the episode."""
    normalized = running_statistics.normalize(observation[..., :-1], statistics)
    return jnp.concatenate([normalized, observation[..., -1:]], axis=-1)


def params_template(config: PPOSettings, observation_size: int, action_size: int) -> Params:
    """The shapes of the parameters, with the structure of a checkpoint."""
    networks = make_networks(config, observation_size, action_size)
    return jax.eval_shape(lambda: initial_params(networks, observation_size, jax.random.PRNGKey(0)))


def make_controller(config: PPOSettings, observation_size: int, action_size: int) -> Callable[[Params], Controller]:
    """The deterministic policy as a function of its parameters."""
    make_policy = ppo_networks.make_inference_fn(make_networks(config, observation_size, action_size))

    def controller(params: Params) -> Controller:
        policy, unused_key = make_policy(params, deterministic=True), jax.random.PRNGKey(0)
        return lambda state: policy(state.obs, unused_key)[0]

    return controller


# Above 40 lines because of its docstring.
def train(
    env: ImitationEnv,
    config: PPOSettings,
    run_dir: Path,
    *,
    seed: int,
    on_evaluation: OnEvaluation,
    signals: Signals,
    restore: tuple[int, Params] | None = None,
    on_compiling: Callable[[], None] = lambda: None,
) -> tuple[int, Params]:
    """Trains a policy, and saves a checkpoint before each call of `on_evaluation`.

    Args:
      env: the environment with its training demonstrations.
      config: the trainer's settings.
      run_dir: folder of the checkpoints.
      seed: random seed of networks, exploration and resets.
      on_evaluation: called for the initial parameters, without metrics, and after each training epoch; the metrics are
        those of the losses, environment steps per second (sps) and seconds of training (walltime).
      signals: signals of the process; after one, training ends at the next checkpoint.
      restore: steps and parameters to continue from. Networks and observation statistics are kept; the moments of the
        optimiser and the states of the environments are reset.
      on_compiling: called when the functions of the training start to compile; it may start work in other threads.

    Returns:
      Environment steps and parameters at the end.

    Raises:
      Interrupted: a signal was received; a checkpoint has been written.
    """
    pending: list[_Checkpoint] = []
    for checkpoint in _checkpoints(env, config, seed, restore, on_compiling):
        save_checkpoint(run_dir, checkpoint.step, checkpoint.params)
        pending.append(checkpoint)
        stop = False
        if checkpoint.metrics:  # the start is evaluated with the first epoch: the evaluation compiles until then
            stop = [on_evaluation(*evaluated) for evaluated in pending][-1]
            pending.clear()
        if checkpoint.step < config.total_steps:  # a finished training is not interrupted: there is nothing to resume
            signals.check()
        if stop:
            break
    return checkpoint.step, checkpoint.params


def follow(env: ImitationEnv, config: PPOSettings, *, seed: int, restore: tuple[int, Params] | None = None) -> None:
    """Runs the same training epochs as the first process, where `train` runs."""
    for _ in _checkpoints(env, config, seed, restore, lambda: None):
        pass


class _Checkpoint(NamedTuple):
    """The result of a training epoch.

    Attributes:
      step: environment steps so far.
      params: parameters on the host.
      metrics: training metrics of the epoch; empty before the first epoch.
    """

    step: int
    params: Params
    metrics: dict[str, float]


def _checkpoints(
    env: ImitationEnv,
    config: PPOSettings,
    seed: int,
    restore: tuple[int, Params] | None,
    on_compiling: Callable[[], None],
) -> Iterator[_Checkpoint]:
    """The start of a training, and the result of each training epoch."""
    step, restored = jax.device_get(restore) if restore else (0, None)
    remaining = max(config.num_timesteps - step, 1)
    evaluations = max(round(config.evaluations * remaining / config.num_timesteps), 1)
    all_batches = -(-remaining // config.steps_per_batch)
    batches = max(round(all_batches / evaluations), 1)
    networks = make_networks(config, env.observation_size, env.action_size)
    progress = _progress(config, step)
    learning_rate = _learning_rate(config, progress)
    start, learn = compile_training(env, config, networks, batches, learning_rate, restored, progress)
    on_compiling()
    state = start()((seed + step) % 2**31)  # the range of a 32-bit integer
    yield _Checkpoint(step, jax.device_get(state.params), {})
    walltime = 0.0
    for _ in range(-(-all_batches // batches)):
        run_epoch = learn()
        began = time.perf_counter()
        state, means = run_epoch(state)
        metrics = {name: float(value) for name, value in jax.device_get(means).items()}
        seconds = time.perf_counter() - began
        walltime += seconds
        step += batches * config.steps_per_batch
        speed = {"sps": batches * config.steps_per_batch / seconds, "walltime": walltime}
        yield _Checkpoint(step, jax.device_get(state.params), {**speed, **metrics})


def _progress(config: PPOSettings, done_steps: int) -> optax.Schedule:
    """Fraction of the whole training that is done after `done_steps` and a number of updates."""
    updates_per_batch = config.num_minibatches * config.num_updates_per_batch
    updates = config.num_timesteps // config.steps_per_batch * updates_per_batch
    done_updates = done_steps // config.steps_per_batch * updates_per_batch
    schedule = optax.linear_schedule(0.0, 1.0, updates)
    return lambda count: schedule(count + done_updates)


def _learning_rate(config: PPOSettings, progress: optax.Schedule) -> optax.Schedule:
    return lambda count: config.learning_rate * (1 + progress(count) * (config.final_learning_rate - 1))
