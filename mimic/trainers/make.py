"""The trainer of a config."""

from pathlib import Path

from mimic import compat
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.trainer import Trainer


def make_trainer(config: TrainConfig, run_dir: Path | None) -> Trainer:
    """What the trainer of a config does; with the inputs of a run directory where there is one.

    Raises:
      ValueError: a config that cannot be trained.
    """
    if isinstance(config.trainer, PoseMapperConfig):
        from mimic.trainers.pose_mapper.trainer import PoseMapperTrainer

        return PoseMapperTrainer(config, run_dir)
    compat.import_mjx()
    from mimic.trainers.ppo.trainer import PPOTrainer  # brax and MJX, which take seconds to import

    return PPOTrainer(config, run_dir)
