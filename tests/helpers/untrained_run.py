"""Run directories of policies of one arm and of many, with their initial parameters."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

import mimic
from mimic.envs.config import EnvConfig
from mimic.runs.checkpoints import save_checkpoint
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.ppo.ppo import initial_params, make_networks
from mimic.trainers.ppo.trainer import PPOTrainer
from mimic.trainers.run_config import save_config
from mimic.trainers.run_models import save_models
from tests.helpers.tiny import SHORT_ARMS

COUNT, HELD_OUT, HORIZON = 4, 2, 20
FAMILY = {"demonstrations": {"count": 3, "held_out": 2}, "horizon": 5}
ARMS = {"most_locked": 1, "unseen": ["2", "3", "4", "5", "6"]}  # seen: whole, and joint 1 or 7 locked


def environment(learner: Sequence[float] = (0.5, 0.5), model: str = "planar") -> EnvConfig:
    """A planar pair that compiles quickly; `model` is a file of another learner."""
    return mimic.env_config(
        "planar4dof",
        expert=SHORT_ARMS["expert"],
        learner={"link_lengths": list(learner), "model": model},
        demonstrations={"count": COUNT, "held_out": HELD_OUT},
        horizon=HORIZON,
    )


def family(**changes: Any) -> EnvConfig:
    """The environment of few Pandas with locked joints, of short episodes."""
    arms = {**ARMS, **changes.pop("arms", {})}
    return mimic.env_config("panda_family", arms=arms, **FAMILY, **changes)


def untrained_run(folder: Path, env: EnvConfig | None = None, **settings: Any) -> Path:
    """What a training run leaves, but with its initial parameters: no training is compiled.

    Args:
      folder: of the run.
      env: the environment; that of `environment` with these settings where None.
      settings: of `environment`.
    """
    config = TrainConfig(env or environment(**settings), PPOConfig(hidden_layers=[8]), compilation_cache="").resolve()
    trainer = PPOTrainer(config, None)
    folder.mkdir()
    save_models(folder, config.env)
    save_config(folder, dataclasses.replace(config, env=trainer.env_config, trainer=trainer.settings))
    trainer.save_inputs(folder)
    env = trainer.evaluator.env
    networks = make_networks(trainer.settings, env.observation_size, env.action_size, env.privileged_size)
    initial = jax.jit(lambda key: initial_params(networks, env.observation_size, key))
    save_checkpoint(folder, 0, initial(jax.random.PRNGKey(2)))  # a policy without jumps
    return folder
