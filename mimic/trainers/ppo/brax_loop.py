"""Training by brax's own PPO loop, on the same environment, networks and checkpoints as `mimic.trainers.ppo.ppo`."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
from brax.training.agents.ppo import train as brax_ppo

from mimic.base import compat
from mimic.envs.imitation import ImitationEnv
from mimic.envs.wrappers import wrap_for_training
from mimic.runs.checkpoints import Checkpoint, save_checkpoint, thin_checkpoints
from mimic.runs.divergence import check_finite
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo.ppo import Params, make_networks
from mimic.trainers.trainer import OnEvaluation

SETTINGS = (
    *("num_timesteps", "num_envs", "learning_rate", "entropy_cost", "discounting", "unroll_length", "batch_size"),
    *("num_minibatches", "num_updates_per_batch", "reward_scaling", "clipping_epsilon", "gae_lambda", "max_grad_norm"),
)
"""Settings of `PPOConfig` that brax's loop has under the same names."""


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
    """Trains a policy by `brax.training.agents.ppo.train.train`. See `ppo.train`, also for the arguments.

    Of a restored checkpoint, brax takes the parameters alone.
    """
    compat.mend_brax()
    on_compiling()
    checkpoints: list[Checkpoint] = []
    evaluated = 0  # the start is evaluated with the first epoch, as by `ppo.train`

    def keep(step: int, _: Any, params: Params) -> None:
        checkpoints.append(Checkpoint(step, jax.device_get(params), None, {}))

    def evaluate(_: int, brax_metrics: Mapping[str, Any]) -> None:
        nonlocal evaluated
        metrics = {name.removeprefix("training/"): float(value) for name, value in brax_metrics.items()}
        checkpoints[-1] = checkpoints[-1]._replace(metrics=metrics)
        for checkpoint in checkpoints[evaluated:]:
            check_finite(checkpoint.step, checkpoint.metrics, checkpoint.params)
            save_checkpoint(run_dir, *checkpoint)
            thin_checkpoints(run_dir, config.keep)
            on_evaluation(checkpoint.step, checkpoint.params, checkpoint.metrics)
        evaluated = len(checkpoints)
        signals.check()

    brax_ppo.train(
        environment=env,
        wrap_env_fn=wrap_for_training,
        episode_length=env.config.horizon + 1,
        normalize_observations=True,
        network_factory=lambda *_, **__: make_networks(
            config, env.observation_size, env.action_size, env.privileged_size
        ),
        num_evals=config.evaluations + 1,
        run_evals=False,
        num_eval_envs=1,
        seed=seed,
        restore_params=None if restored is None else restored.params,
        policy_params_fn=keep,
        progress_fn=evaluate,
        **{name: getattr(config, name) for name in SETTINGS},
    )
    return checkpoints[-1].step, checkpoints[-1].params
