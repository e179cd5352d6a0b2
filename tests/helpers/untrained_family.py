"""A run directory of a policy of many arms with its initial parameters."""

import dataclasses
from pathlib import Path
from typing import Any

import jax

import mimic
from mimic.envs.config import EnvConfig
from mimic.runs.checkpoints import save_checkpoint
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.make import make_any_arm_trainer
from mimic.trainers.ppo.ppo import initial_params, make_networks
from mimic.trainers.run_config import save_config
from mimic.trainers.run_models import save_models

COUNT, HELD_OUT, HORIZON = 3, 2, 5
ARMS = {"most_locked": 1, "unseen": ["2", "3", "4", "5", "6"]}  # seen: whole, and joint 1 or 7 locked


def family(**changes: Any) -> EnvConfig:
    """The environment of few Pandas, of short episodes."""
    arms = {**ARMS, **changes.pop("arms", {})}
    demonstrations = {"count": COUNT, "held_out": HELD_OUT}
    return mimic.env_config("panda_family", arms=arms, demonstrations=demonstrations, horizon=HORIZON, **changes)


def untrained_family(folder: Path, **changes: Any) -> Path:
    """What a training run leaves, but with its initial parameters: no training is compiled."""
    config = TrainConfig(family(**changes), PPOConfig(hidden_layers=[8]), compilation_cache="").resolve()
    trainer = make_any_arm_trainer(config, None)
    folder.mkdir()
    save_models(folder, config.env)
    save_config(folder, dataclasses.replace(config, env=trainer.env_config, trainer=trainer.settings))
    trainer.save_inputs(folder)
    size = trainer.evaluator.env.observation_size, trainer.evaluator.env.action_size
    networks = make_networks(trainer.settings, *size)
    initial = jax.jit(lambda key: initial_params(networks, size[0], key))
    save_checkpoint(folder, 0, initial(jax.random.PRNGKey(0)))
    return folder
