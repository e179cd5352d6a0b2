"""Lower bounds on the memory that a training needs, compared with what there is before anything is compiled."""

import dataclasses
import itertools
from collections.abc import Sequence

from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS
from mimic.arms.embodiment import Embodiment
from mimic.base.memory import check_memory, device_memory, host_memory
from mimic.envs.many_arms_observation import observation_size
from mimic.trainers.config import PoseMapperConfig, PPOConfig, TrainConfig

_FLOAT32, _FLOAT64 = 4, 8  # bytes
_COPIES = 4  # of the parameters: themselves, their gradients, Adam's two moments
_NETWORKS = 2  # policy and value


def check_training_memory(config: TrainConfig) -> None:
    """Raises a ValueError that names the settings of the largest part if a training cannot fit into the memory.

    Args:
      config: of the training, with a resolved trainer.

    Raises:
      ValueError: also where the arms are invalid.
    """
    # Where the learner is drawn, the whole one counts.
    env = dataclasses.replace(config.env, arms=None)
    expert, learner = env.build_arms().embodiments
    if isinstance(config.trainer, PPOConfig):
        _check("host", _demonstration_bytes(config, expert), host_memory())
        _check("device", _ppo_bytes(config, config.trainer, expert, learner), device_memory())
    elif isinstance(config.trainer, PoseMapperConfig) and config.env.kind == "sampled_arms":
        _check("device", _any_arm_mapper_bytes(config.trainer), device_memory())
    elif isinstance(config.trainer, PoseMapperConfig):
        _check("device", _mapper_bytes(config.trainer, expert, learner), device_memory())


def _check(where: str, parts: dict[str, float], available: int | None) -> None:
    check_memory(max(parts, key=lambda part: parts[part]), sum(parts.values()), available, where)


def _demonstration_bytes(config: TrainConfig, expert: Embodiment) -> dict[str, float]:
    """Angles and velocities at each step of the demonstrations that are recorded."""
    settings = config.env.demonstrations
    count = 0 if settings.path else settings.count + settings.held_out
    numbers = 2.0 * count * config.env.horizon * expert.num_joints
    return {"env.demonstrations.count, env.horizon": numbers * _FLOAT64}


def _ppo_bytes(config: TrainConfig, settings: PPOConfig, expert: Embodiment, learner: Embodiment) -> dict[str, float]:
    """Networks; observations of a batch and of the environments; hidden units of a minibatch."""
    observation = 12 * (learner.num_links + (config.env.preview + 1) * expert.num_links)
    if config.env.kind == "sampled_arms":
        observation = observation_size(expert.num_links)
    networks = 1 if settings.network == "joints" else _NETWORKS  # with hidden layers; the other one is small
    widths = [observation, *settings.hidden_layers, 1]
    units = float(settings.batch_size * settings.unroll_length * sum(settings.hidden_layers))
    return {
        "trainer.hidden_layers": _network_bytes(widths) * networks,
        "trainer.batch_size, trainer.unroll_length, trainer.hidden_layers": units * networks * _FLOAT32,
        "trainer.batch_size, trainer.num_minibatches, trainer.unroll_length": (
            float(settings.steps_per_batch) * observation * _FLOAT32
        ),
        "trainer.num_envs": float(settings.num_envs) * observation * _FLOAT32,
    }


def _mapper_bytes(settings: PoseMapperConfig, expert: Embodiment, learner: Embodiment) -> dict[str, float]:
    """Network; poses of all splits; hidden units of a minibatch."""
    poses = float(settings.samples + settings.validation_poses + settings.held_out_poses)
    widths = [expert.num_joints, *settings.hidden_layers, settings.heads * learner.num_joints]
    return {
        "trainer.hidden_layers, trainer.heads": _network_bytes(widths),
        "trainer.samples, trainer.validation_poses, trainer.held_out_poses": poses * expert.num_joints * _FLOAT32,
        "trainer.batch_size, trainer.hidden_layers": float(settings.batch_size) * sum(widths) * _FLOAT32,
    }


def _any_arm_mapper_bytes(settings: PoseMapperConfig) -> dict[str, float]:
    """Network; hidden units of a minibatch, each token of a link has those of all layers; Jacobians of Newton steps."""
    units = float(settings.width) * settings.layers
    poses = float(settings.held_out_poses) * (settings.heads + settings.guesses)
    return {
        "trainer.held_out_poses, trainer.heads, trainer.guesses": poses * 6 * MAX_LINKS * MAX_JOINTS * _FLOAT32,
        "trainer.width, trainer.layers": 8 * units * settings.width * _COPIES * _FLOAT32,  # attention 4, then 2 and 2
        "trainer.batch_size, trainer.width, trainer.layers": settings.batch_size * MAX_LINKS * units * _FLOAT32,
    }


def _network_bytes(widths: Sequence[int]) -> float:
    return float(sum(a * b for a, b in itertools.pairwise(widths))) * _COPIES * _FLOAT32
