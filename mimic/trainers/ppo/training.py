"""PPO on an imitation environment: networks, training epochs, checkpoints."""

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import optax
from brax.training.agents.ppo import networks as ppo_networks

from mimic.envs.imitation import ImitationEnv
from mimic.evaluation.evaluator import Controller
from mimic.runs.checkpoints import (
    STATE_UNUSED,
    Checkpoint,
    DamagedCheckpoint,
    checkpoint_steps,
    load_checkpoint,
    save_checkpoint,
    thin_checkpoints,
)
from mimic.runs.divergence import check_finite
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo.networks import make_networks
from mimic.trainers.ppo.programs import (
    Metrics,
    Params,
    TrainingFunctions,
    TrainingState,
    compile_training,
    initial_params,
    saved_leaves,
)
from mimic.trainers.trainer import OnEvaluation

Score = Callable[[Params], float]  # of parameters, the smaller the better


class _Best(NamedTuple):
    """The checkpoint with the smallest score so far."""

    score: float
    step: int
    params: Params


def params_template(config: PPOConfig, observation_size: int, action_size: int) -> Params:
    """The shapes of the parameters, with the structure of a checkpoint."""
    networks = make_networks(config, observation_size, action_size)
    return jax.eval_shape(lambda: initial_params(networks, observation_size, jax.random.PRNGKey(0)))


def make_controller(config: PPOConfig, observation_size: int, action_size: int) -> Callable[[Params], Controller]:
    """The deterministic policy as a function of its parameters."""
    make_policy = ppo_networks.make_inference_fn(make_networks(config, observation_size, action_size))

    def controller(params: Params) -> Controller:
        policy, unused_key = make_policy(params, deterministic=True), jax.random.PRNGKey(0)
        return lambda state: policy(state.obs, unused_key)[0]

    return controller


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
    score: Score | None = None,
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
      restored: the checkpoint to continue from. With the training's state the result is that of a training that was not
        interrupted; without it, the optimizer and the environments start anew.
      on_compiling: called when the functions of the training start to compile; it may start work in other threads.
      score: chooses the result: the checkpoint with the smallest value, unless `on_evaluation` ended the training.
        None: the last checkpoint.

    Returns:
      Environment steps and parameters of the result.

    Raises:
      Interrupted: a signal was received; a checkpoint has been written.
      Diverged: a number is not finite.
      OSError: a checkpoint cannot be written.
    """
    best: _Best | None = None
    pending: list[Checkpoint] = []
    stop = False
    for checkpoint in _checkpoints(env, config, seed, restored, on_compiling):
        if score and restored and checkpoint.step == restored.step:
            best = _best_saved(run_dir, restored, score)  # here: its function compiles as that of the training does
        if checkpoint.step not in checkpoint_steps(run_dir):
            save_checkpoint(run_dir, *checkpoint)
            thin_checkpoints(run_dir, config.keep, best and best.step)
        pending.append(checkpoint)
        if checkpoint.metrics:  # the start is evaluated with the first epoch: the evaluation compiles until then
            stop = [on_evaluation(each.step, each.params, each.metrics) for each in pending][-1]
            if score:
                best = _better(best, pending, score)  # after the evaluation of the same parameters
            pending.clear()
        if checkpoint.step < config.total_steps:  # a finished training is not interrupted: there is nothing to resume
            signals.check()
        if stop:
            break
    return (best.step, best.params) if best and not stop else (checkpoint.step, checkpoint.params)


def _better(best: _Best | None, checkpoints: Iterable[Checkpoint], score: Score) -> _Best | None:
    """The best of the best so far and of some checkpoints; the earlier one of equal ones."""
    for checkpoint in checkpoints:
        value = score(checkpoint.params)
        value = value if math.isfinite(value) else math.inf
        if best is None or value < best.score:
            best = _Best(value, checkpoint.step, checkpoint.params)
    return best


def _best_saved(run_dir: Path, restored: Checkpoint, score: Score) -> _Best | None:
    """The best checkpoint of a resumed run before the restored one; None where there is none."""
    best = None
    for step in checkpoint_steps(run_dir):
        if step < restored.step:
            try:
                saved = Checkpoint(*load_checkpoint(run_dir, restored.params, step), None, {})
            except DamagedCheckpoint as error:
                print(f"warning: {error}; it cannot be the result", file=sys.stderr)
                continue
            best = _better(best, [saved], score)
    return best


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
    batches = _batches_per_epoch(config)
    functions = _compile(env, config, batches, initial, restored=leaves is not None)
    on_compiling()
    state = None if leaves is None else functions.restore(leaves, _updates(config, step))
    leaves = None  # frees their memory
    if state is None:
        state = _start_anew(functions, config, seed, step, initial)
    yield Checkpoint(step, jax.device_get(state.params), saved_leaves(state), metrics)
    walltime = metrics.get("walltime", 0.0)
    while step < config.num_timesteps:
        state, metrics, seconds = _timed(functions.epoch(), state)
        walltime += seconds
        step += batches * config.steps_per_batch
        params = jax.device_get(state.params)
        check_finite(step, metrics, params)
        speed = {"sps": batches * config.steps_per_batch / seconds, "walltime": walltime}
        yield Checkpoint(step, params, saved_leaves(state), {**speed, **metrics})


def _compile(
    env: ImitationEnv, config: PPOConfig, batches: int, initial: Params | None, *, restored: bool
) -> TrainingFunctions:
    networks = make_networks(config, env.observation_size, env.action_size)
    progress = _progress(config)
    learning_rate = _learning_rate(config, progress)
    return compile_training(env, config, networks, batches, learning_rate, initial, progress, restored=restored)


def _start_anew(
    functions: TrainingFunctions, config: PPOConfig, seed: int, step: int, initial: Params | None
) -> TrainingState:
    """The state at a step where none is saved, or none that fits the settings."""
    if step and jax.process_index() == 0:
        print(STATE_UNUSED, file=sys.stderr)
    return functions.start((seed + step) % 2**31, initial, _updates(config, step))  # the range of a 32-bit integer


def _timed(
    run_epoch: Callable[[TrainingState], tuple[TrainingState, Metrics]], state: TrainingState
) -> tuple[TrainingState, dict[str, float], float]:
    """The state after an epoch, its metrics on the host, and its time [s]."""
    began = time.perf_counter()
    state, means = run_epoch(state)
    metrics = {name: float(value) for name, value in jax.device_get(means).items()}
    return state, metrics, time.perf_counter() - began


def _batches_per_epoch(config: PPOConfig) -> int:
    """Batches between two evaluations. A resumed training has the same, and so the same compiled function."""
    batches = -(-config.num_timesteps // config.steps_per_batch)
    return max(round(batches / config.evaluations), 1)


def _updates(config: PPOConfig, step: int) -> int:
    """Updates of a network in a number of environment steps."""
    return step // config.steps_per_batch * config.num_minibatches * config.num_updates_per_batch


def _progress(config: PPOConfig) -> optax.Schedule:
    """Fraction of the training that is done after a number of updates."""
    return optax.linear_schedule(0.0, 1.0, _updates(config, config.num_timesteps))


def _learning_rate(config: PPOConfig, progress: optax.Schedule) -> optax.Schedule:
    return lambda count: config.learning_rate * (1 + progress(count) * (config.final_learning_rate - 1))
