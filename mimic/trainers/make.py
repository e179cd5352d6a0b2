"""Makes the trainer of a config, by its name."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import jax

from mimic.base import compat, registry
from mimic.envs.family import with_one_learner
from mimic.motions.demonstrations import Demonstrations
from mimic.trainers.config import TrainConfig
from mimic.trainers.trainer import Trainer

if TYPE_CHECKING:
    from mimic.trainers.ppo.trainer import PPOTrainer


def make_trainer(config: TrainConfig, run_dir: Path | None) -> Trainer:
    """The trainer of a config.

    Args:
      config: the run's config.
      run_dir: directory of an existing run, whose inputs are used; None for a new run.

    Raises:
      ValueError: a config that cannot be trained.
    """
    name = config.trainer.name
    config = config.resolve(jax.default_backend(), jax.device_count())
    if name in _MAKERS:
        return _MAKERS[name](config, run_dir)
    compat.import_mjx()  # first, and quietly: the trainer may import brax
    return registry.find("trainer", name, "trainer.name")(config, run_dir)


def make_ppo_trainer(
    config: TrainConfig,
    run_dir: Path | None,
    unseen: Demonstrations | None = None,
    shared: "PPOTrainer | None" = None,
) -> "PPOTrainer":
    """The trainer of a config with trainer=ppo; see `PPOTrainer`."""
    compat.import_mjx()
    from mimic.trainers.ppo.trainer import PPOTrainer  # brax and MJX, which take seconds to import

    return PPOTrainer(config, run_dir, unseen, shared)


def make_policy_trainer(
    config: TrainConfig, run_dir: Path, learner: str = "", locked: Sequence[int | str] = ()
) -> "tuple[TrainConfig, PPOTrainer]":
    """The trainer that evaluates a run's policy on one learner, and the config of its environment.

    Args:
      config: of a run of trainer=ppo.
      run_dir: its directory.
      learner: of a run of many arms: name or file of the one to evaluate on.
      locked: numbers or names of the joints of `learner` that are locked.

    Raises:
      ValueError: a learner for a run of one, none for a run of many, or one that its policy cannot move.
    """
    if config.env.kind != "sampled_arms":
        if learner:
            raise ValueError(f"learner: expected none for a run of one learner, got {learner!r}")
        return config, make_ppo_trainer(config, run_dir)
    if not learner:
        raise ValueError(
            f"learner: expected one arm for a run of many, env={config.env.name}, as in learner=panda locked=[2,4]"
        )
    of_one = dataclasses.replace(config, env=with_one_learner(config.env, learner, locked))
    return of_one, make_ppo_trainer(of_one, run_dir, shared=make_ppo_trainer(config, run_dir))


def _make_pose_mapper_trainer(config: TrainConfig, run_dir: Path | None) -> Trainer:
    from mimic.trainers.pose_mapper.trainer import PoseMapperTrainer

    return PoseMapperTrainer(config, run_dir)


_MAKERS: dict[str, Callable[[TrainConfig, Path | None], Trainer]] = {
    "ppo": make_ppo_trainer,
    "pose_mapper": _make_pose_mapper_trainer,
}
