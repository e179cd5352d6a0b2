"""Brax PPO on an imitation environment: called as the library that it is, watched from its callback."""

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.envs.base import Env, State, Wrapper
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as brax_ppo

from mimic import compat
from mimic.envs.imitation import ImitationEnv
from mimic.envs.wrappers import wrap_for_training
from mimic.trainers.checkpoints import save_checkpoint
from mimic.trainers.config import PPOConfig
from mimic.trainers.evaluation import Controller
from mimic.trainers.signals import Signals

Params = Any  # observation statistics, policy parameters, value parameters
OnEvaluation = Callable[[int, Params, dict[str, float]], bool]  # whether that is good enough to stop


_LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"  # what JAX tells before it calls the compiler


class _NoEpisodes(Env):
    """What brax's own evaluator is given, which compiles its reset although it is never used."""

    observation_size = action_size = 0
    backend = ""

    def reset(self, rng: jax.Array) -> State:
        """Nothing, for each key."""
        zero = jnp.zeros(rng.shape[0])
        return State(None, zero, zero, zero)

    def step(self, state: State, action: jax.Array) -> State:
        """Never called."""
        raise NotImplementedError


class _Announced(Wrapper):
    """Tells when the first program that steps the environment, the training, has been traced and is to be compiled.

    From then on the compiler leaves Python to other threads; what they traced before would hold the training up.
    """

    def __init__(self, env: Env, then: Callable[[], None]):
        super().__init__(env)
        self._then = then
        self._traced = False
        jax.monitoring.register_event_duration_secs_listener(self._on_event)

    def step(self, state: State, action: jax.Array) -> State:
        """Of the environment."""
        self._traced = True
        return self.env.step(state, action)

    def _on_event(self, event: str, duration_secs: float, **_: Any) -> None:
        del duration_secs
        if self._traced and event == _LOWERED:
            jax.monitoring.unregister_event_duration_listener(self._on_event)
            self._then()


class _GoodEnough(Exception):  # noqa: N818 - not an error: brax has no other way to be stopped
    """Training has reached what was asked for."""


class LearningRate:
    """A linear decay that brax takes for a number: optax calls it, and brax's log shows where it started."""

    def __init__(self, start: float, end: float, updates: int, done: int = 0):
        self.start = start
        self._schedule = optax.linear_schedule(start, end, updates)
        self._done = done

    def __call__(self, count: jax.Array) -> jax.Array:
        """Learning rate at an update."""
        return self._schedule(count + self._done)

    def __jax_array__(self) -> jax.Array:
        """The rate at the start."""
        return jnp.asarray(self.start, jnp.float32)


def make_networks(config: PPOConfig, observation_size: int, action_size: int) -> ppo_networks.PPONetworks:
    """Policy and value network of a resolved config."""
    return _network_factory(config)(
        observation_size, action_size, preprocess_observations_fn=running_statistics.normalize
    )


def hyperparameters(config: PPOConfig) -> dict[str, Any]:
    """Of a resolved config, as brax takes them; without the learning rate, whose decay depends on what is done."""
    return {
        "num_envs": config.num_envs,
        "entropy_cost": config.entropy_cost,
        "discounting": config.discounting,
        "unroll_length": config.unroll_length,
        "batch_size": config.batch_size,
        "num_minibatches": config.num_minibatches,
        "num_updates_per_batch": config.num_updates_per_batch,
        "normalize_observations": True,
        "reward_scaling": config.reward_scaling,
        "clipping_epsilon": config.clipping_epsilon,
        "gae_lambda": config.gae_lambda,
        "max_grad_norm": config.max_grad_norm,
        "network_factory": _network_factory(config),
    }


def _network_factory(config: PPOConfig) -> Callable[..., ppo_networks.PPONetworks]:
    """Brax's networks, each initialised by one program: flax would compile one for each operation."""
    hidden = tuple(config.hidden_layers or ())

    def make(*sizes: Any, **more: Any) -> ppo_networks.PPONetworks:
        networks = ppo_networks.make_ppo_networks(
            *sizes, policy_hidden_layer_sizes=hidden, value_hidden_layer_sizes=hidden, **more
        )
        policy, value = (
            dataclasses.replace(network, init=jax.jit(network.init))
            for network in (networks.policy_network, networks.value_network)
        )
        return networks.replace(policy_network=policy, value_network=value)

    return make


def params_template(config: PPOConfig, observation_size: int, action_size: int) -> Params:
    """Parameters of the right structure, to restore a checkpoint into."""
    networks = make_networks(config, observation_size, action_size)

    def initial() -> Params:
        key = jax.random.PRNGKey(0)
        statistics = running_statistics.init_state(specs.Array((observation_size,), jnp.dtype("float32")))
        return statistics, networks.policy_network.init(key), networks.value_network.init(key)

    return jax.jit(initial)()


def make_controller(config: PPOConfig, observation_size: int, action_size: int) -> Callable[[Params], Controller]:
    """The deterministic policy as a function of its parameters."""
    make_policy = ppo_networks.make_inference_fn(make_networks(config, observation_size, action_size))

    def controller(params: Params) -> Controller:
        policy, unused_key = make_policy(params, deterministic=True), jax.random.PRNGKey(0)
        return lambda state: policy(state.obs, unused_key)[0]

    return controller


def train(
    env: ImitationEnv,
    config: PPOConfig,
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
      on_evaluation: called with the environment steps so far, the parameters and brax's training metrics; training
        ends where it returns True.
      signals: training ends after the next checkpoint if one came.
      restore: steps and parameters to go on from. Networks and observation statistics are kept; the moments of the
        optimiser and the states of the environments start anew.
      on_compiling: called when the training program begins to compile: time for work in other threads.

    Returns:
      Environment steps and parameters at the end.

    Raises:
      Interrupted: a signal came; a checkpoint is written.
    """
    compat.mend_brax()
    done_steps = restore[0] if restore else 0
    latest: dict[str, Any] = {}

    def on_params(step: int, _: Any, params: Params) -> None:
        step += done_steps
        save_checkpoint(run_dir, step, params)
        latest.update(step=step, params=params)
        if step == done_steps:
            # Looked at with the first result: the evaluation compiles while brax compiles the training.
            latest["start"] = jax.device_get(params)
            signals.check()

    def on_metrics(_: int, metrics: dict[str, Any]) -> None:
        if "start" in latest:
            on_evaluation(done_steps, latest.pop("start"), {})
        named = {name.removeprefix("training/"): float(value) for name, value in metrics.items()}
        enough = on_evaluation(latest["step"], latest["params"], named)
        if latest["step"] < config.num_timesteps:  # else all is done, and there is nothing to resume
            signals.check()
        if enough:
            raise _GoodEnough

    with contextlib.suppress(_GoodEnough):
        brax_ppo.train(
            progress_fn=on_metrics,
            policy_params_fn=on_params,
            **_brax_arguments(env, config, seed, restore, on_compiling),
        )
    return latest["step"], latest["params"]


def follow(env: ImitationEnv, config: PPOConfig, *, seed: int, restore: tuple[int, Params] | None = None) -> None:
    """Trains in step with the first process, where `train` runs; brax calls nothing back here."""
    compat.mend_brax()
    brax_ppo.train(**_brax_arguments(env, config, seed, restore, lambda: None))


def _brax_arguments(
    env: ImitationEnv,
    config: PPOConfig,
    seed: int,
    restore: tuple[int, Params] | None,
    on_compiling: Callable[[], None],
) -> dict[str, Any]:
    done_steps, params = restore or (0, None)
    unused = _NoEpisodes()

    def wrap(env: Env, *how: Any, **more: Any) -> Env:
        return env if env is unused else _Announced(wrap_for_training(env, *how, **more), on_compiling)

    updates_per_batch = config.num_minibatches * config.num_updates_per_batch  # type: ignore[operator]
    updates = config.num_timesteps // config.steps_per_batch * updates_per_batch  # type: ignore[operator]
    done_updates = done_steps // config.steps_per_batch * updates_per_batch
    left = max(config.num_timesteps - done_steps, 1)  # type: ignore[operator]
    evaluations = max(round(config.evaluations * left / config.num_timesteps), 1)  # type: ignore[operator]
    rate: float = config.learning_rate  # type: ignore[assignment]
    final_share: float = config.final_learning_rate  # type: ignore[assignment]
    return {
        "environment": env,
        "restore_params": params,
        "seed": seed + done_steps,
        "num_timesteps": left,
        "episode_length": env.config.horizon + 1,  # the environment ends first
        "wrap_env_fn": wrap,
        "eval_env": unused,
        "learning_rate": LearningRate(rate, rate * final_share, updates, done_updates),
        **hyperparameters(config),
        "num_evals": evaluations + 1,
        "num_eval_envs": 1,
        "run_evals": False,  # our evaluator's program is smaller, and it knows the held-out demonstrations
    }
