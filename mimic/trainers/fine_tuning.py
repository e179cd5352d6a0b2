"""Trains a policy of many arms further on one of them: `python -m mimic.train init=DIR learner=NAME`."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from omegaconf import DictConfig, OmegaConf

from mimic.arms.arm import ArmConfig
from mimic.arms.arrays import masked_arrays
from mimic.base.config import to_dict, typed
from mimic.envs.config import ArmsConfig, EnvConfig
from mimic.envs.family import arm_name, arms_config
from mimic.trainers.config import TrainConfig
from mimic.trainers.run_config import load_config, run_schema

_OWN = ("seed", "run_dir", "init", "learner", "logger", "compilation_cache", "distributed")  # of the new run
_FIXED = ("trainer.name=", "trainer.preset=", "trainer.network=", "trainer.hidden_layers=", "trainer.timed_critic=")


def fine_tuned(requested: TrainConfig, overrides: Sequence[str]) -> TrainConfig:
    """The config of the run `init`, with the arm `learner` as the only one, and the overrides of the trainer.

    Args:
      requested: config of the command line.
      overrides: its overrides.

    Raises:
      ValueError: no run of many arms, or overrides of what the policy was trained with.
    """
    run = load_config(Path(requested.init).expanduser())
    if run.env.kind != "sampled_arms":
        raise ValueError(f"learner: expected init=DIR of a run of many arms, got one of env={run.env.name}")
    if run.trainer.name != "ppo":
        raise ValueError(f"learner: expected init=DIR of a run of trainer=ppo, got one of {run.trainer.name}")
    own_keys = tuple(f"{key}{end}" for key in _OWN for end in "=.")
    changes = [text for text in overrides if not text.startswith(own_keys) and text != "trainer=ppo"]
    for text in changes:
        if not text.startswith("trainer.") or text.startswith(_FIXED):
            raise ValueError(
                f"learner: expected overrides of the length and rates of the trainer only, as in "
                f"trainer.num_timesteps=N; all else is that of the run in init, got {text!r}"
            )
    merged = OmegaConf.merge(run_schema(run.trainer.name), to_dict(run), OmegaConf.from_dotlist(changes))
    config: TrainConfig = typed(cast(DictConfig, merged))
    own = {key: getattr(requested, key) for key in _OWN}
    return dataclasses.replace(config, env=with_only_arm(run.env, requested.learner), resume="", **own)


def with_only_arm(env: EnvConfig, model: str) -> EnvConfig:
    """The environment of many arms whose only arm is this one.

    Args:
      env: the environment of a run of many arms.
      model: the arm, see `ArmConfig.model`.
    """
    kept = {key: getattr(arms_config(env), key) for key in ("reward", "armature", "damping")}
    arms = ArmsConfig(locked_fraction=1.0, most_locked=0, **kept)
    learner = arm_of(env, model)
    return dataclasses.replace(env, name=f"{env.name}-{arm_name(learner)}", arms=arms, learner=learner)


def with_one_learner(env: EnvConfig, model: str, locked: Sequence[int | str]) -> EnvConfig:
    """The environment of one learner with all else as in the environment of many arms.

    Args:
      env: the environment of a run of many arms.
      model: the learner, see `ArmConfig.model`.
      locked: its locked joints, by number or name.

    Raises:
      ValueError: there is no such arm, or a policy of many arms cannot move it.
    """
    learner = dataclasses.replace(arm_of(env, model), locked=list(locked) or None)
    label = "-".join([env.name, arm_name(learner), *(["locked", *map(str, locked)] if locked else [])])
    config = dataclasses.replace(env, name=label, arms=None, learner=learner, physics="auto")
    masked_arrays(learner, config.limits, config.metric.links)
    return config


def arm_of(env: EnvConfig, model: str) -> ArmConfig:
    """The config of an arm by its name or file, with the minimum rotor inertia and damping of the environment's arms.

    Raises:
      ValueError: there is no such arm.
    """
    arms = arms_config(env)
    return ArmConfig(model=model, armature=arms.armature, damping=arms.damping)
