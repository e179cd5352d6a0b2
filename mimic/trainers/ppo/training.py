"""PPO on an imitation environment: networks, training in stretches, checkpoints."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import optax
from brax.training.acme import running_statistics
from brax.training.agents.ppo import networks as ppo_networks

from mimic.envs.imitation import ImitationEnv
from mimic.evaluation.evaluator import Controller
from mimic.runs.checkpoints import save_checkpoint
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOSettings
from mimic.trainers.ppo.programs import Params, initial_params, make_programs

OnEvaluation = Callable[[int, Params, dict[str, float]], bool]  # whether that is good enough to stop


def make_networks(config: PPOSettings, observation_size: int, action_size: int) -> ppo_networks.PPONetworks:
    """Policy and value network of a resolved config."""
    hidden = tuple(config.hidden_layers or ())
    return ppo_networks.make_ppo_networks(
        observation_size,
        action_size,
        preprocess_observations_fn=running_statistics.normalize,
        policy_hidden_layer_sizes=hidden,
        value_hidden_layer_sizes=hidden,
    )


def params_template(config: PPOSettings, observation_size: int, action_size: int) -> Params:
    """Shapes of the parameters, to restore a checkpoint into."""
    networks = make_networks(config, observation_size, action_size)
    return jax.eval_shape(lambda: initial_params(networks, observation_size, jax.random.PRNGKey(0)))


def make_controller(config: PPOSettings, observation_size: int, action_size: int) -> Callable[[Params], Controller]:
    """The deterministic policy as a function of its parameters."""
    make_policy = ppo_networks.make_inference_fn(make_networks(config, observation_size, action_size))

    def controller(params: Params) -> Controller:
        policy, unused_key = make_policy(params, deterministic=True), jax.random.PRNGKey(0)
        return lambda state: policy(state.obs, unused_key)[0]

    return controller


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
    """Trains a policy; saves a checkpoint before each call of `on_evaluation`.

    Args:
      env: the environment with its training demonstrations.
      config: resolved.
      run_dir: where checkpoints go.
      seed: of networks, exploration and resets.
      on_evaluation: called with the environment steps so far, the parameters and metrics of the training: means of the
        loss's, environment steps per second (sps) and seconds of training (walltime); training ends where it returns
        True. The first call is before the training, without metrics.
      signals: training ends after the next checkpoint if one came.
      restore: steps and parameters to go on from. Networks and observation statistics are kept; the moments of the
        optimiser and the states of the environments start anew.
      on_compiling: called when the training program begins to compile: time for work in other threads.

    Returns:
      Environment steps and parameters at the end.

    Raises:
      Interrupted: a signal came; a checkpoint is written.
    """
    results: list[_Stretch] = []
    for result in _stretches(env, config, seed, restore, on_compiling):
        save_checkpoint(run_dir, result.step, result.params)
        results.append(result)
        enough = False
        if result.metrics:  # the start is looked at with the first result: until then the evaluation compiles
            enough = [on_evaluation(*seen) for seen in results][-1]
            results.clear()
        if result.step < config.total_steps:  # else all is done, and there is nothing to resume
            signals.check()
        if enough:
            break
    return result.step, result.params


def follow(env: ImitationEnv, config: PPOSettings, *, seed: int, restore: tuple[int, Params] | None = None) -> None:
    """Trains in step with the first process, where `train` runs."""
    for _ in _stretches(env, config, seed, restore, lambda: None):
        pass


class _Stretch(NamedTuple):
    """What a training has come to after a call of its program.

    Attributes:
      step: environment steps so far.
      params: on the host.
      metrics: of the call; empty before the first.
    """

    step: int
    params: Params
    metrics: dict[str, float]


def _stretches(
    env: ImitationEnv,
    config: PPOSettings,
    seed: int,
    restore: tuple[int, Params] | None,
    on_compiling: Callable[[], None],
) -> Iterator[_Stretch]:
    """The start of a training, and the end of each of its stretches."""
    step, restored = jax.device_get(restore) if restore else (0, None)
    left = max(config.num_timesteps - step, 1)
    evaluations = max(round(config.evaluations * left / config.num_timesteps), 1)
    all_batches = -(-left // config.steps_per_batch)
    batches = max(round(all_batches / evaluations), 1)
    networks = make_networks(config, env.observation_size, env.action_size)
    begin, learn = make_programs(env, config, networks, batches, _learning_rate(config, step), restored)
    on_compiling()
    learning = begin()((seed + step) % 2**31)  # what a 32-bit integer holds
    yield _Stretch(step, jax.device_get(learning.params), {})
    walltime = 0.0
    for _ in range(-(-all_batches // batches)):
        program = learn()
        began = time.perf_counter()
        learning, means = program(learning)
        metrics = {name: float(value) for name, value in jax.device_get(means).items()}
        seconds = time.perf_counter() - began
        walltime += seconds
        step += batches * config.steps_per_batch
        speed = {"sps": batches * config.steps_per_batch / seconds, "walltime": walltime}
        yield _Stretch(step, jax.device_get(learning.params), {**speed, **metrics})


def _learning_rate(config: PPOSettings, done_steps: int) -> optax.Schedule:
    """A linear decay over the updates of the whole training, from those that are done."""
    updates_per_batch = config.num_minibatches * config.num_updates_per_batch
    updates = config.num_timesteps // config.steps_per_batch * updates_per_batch
    done_updates = done_steps // config.steps_per_batch * updates_per_batch
    start = config.learning_rate
    schedule = optax.linear_schedule(start, start * config.final_learning_rate, updates)
    return lambda count: schedule(count + done_updates)
