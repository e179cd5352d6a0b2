"""The arms of an environment whose learner is drawn for each episode: its sampler, and the arms of its report."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, ArmArrays, arm_arrays, lock_joints, masked_arrays
from mimic.arms.sampler import (
    Sampler,
    lock_masks,
    lock_sampler,
    mixed_sampler,
    perturbed_sampler,
    random_arm,
)
from mimic.envs.config import ArmsConfig, EnvConfig, ObservationConfig, RewardConfig

SEEN, UNSEEN = "seen", "unseen"
_RANDOM_ARMS = 16  # in a report
_RANDOM_SEED = 2**20  # of the random arms of a report; training draws from other keys

_random_arms = jax.jit(jax.vmap(random_arm))


def arms_config(config: EnvConfig) -> ArmsConfig:
    """What the learners of an environment are drawn from.

    Raises:
      ValueError: an environment of one learner.
    """
    if config.arms is None:
        raise ValueError(
            f"env: expected one that draws its learners, as any_arm or panda_family, got {config.name!r} of one learner"
        )
    return config.arms


def arm_sampler(config: EnvConfig) -> Sampler:
    """Draws the learner of an episode of training.

    Raises:
      ValueError: an arm that cannot be loaded or has too many joints, or a set of joints that the learner lacks.
    """
    arms = arms_config(config)
    parts: list[tuple[float, Sampler]] = []
    if arms.locked_fraction:
        base = _arrays(config, config.learner)
        parts.append((arms.locked_fraction, lock_sampler(base, _masks(config, base))))
    if arms.perturbed_fraction:
        parts.append(
            (arms.perturbed_fraction, perturbed_sampler([_arrays(config, _model(arms, name)) for name in arms.models]))
        )
    if arms.random_fraction:
        parts.append((arms.random_fraction, random_arm))
    total = sum(weight for weight, _ in parts)
    samplers = [sampler for _, sampler in parts]
    return samplers[0] if len(parts) == 1 else mixed_sampler(samplers, [weight / total for weight, _ in parts])


def check_family(config: EnvConfig) -> None:
    """Raises a ValueError for settings that an environment of many arms does not have."""
    supported = {
        "physics": ("auto", "fused"),
        "preview": (1,),
        "reward": (RewardConfig(),),
        "observation": (ObservationConfig(),),
        "environment": ("",),
    }
    for key, values in supported.items():
        value = getattr(config, key)
        if value not in values:
            is_plain = isinstance(values[0], int | str) and values[0]
            expected = " or ".join(map(str, values)) if is_plain else "the default"
            raise ValueError(
                f"{key}: expected {expected} where the learner is drawn for each episode, got {_changes(value)}"
            )


def report_arms(config: EnvConfig) -> dict[str, dict[str, ArmArrays]]:
    """The arms of the report by name, those that training has seen and those that it has not.

    Seen are the locked variants of the learner, and the models as they are. Unseen are the sets `unseen`, the models
    `evaluated`, and, where training draws random arms, others of these.

    Raises:
      ValueError: see `arm_sampler`, or two arms of one name.
    """
    arms = arms_config(config)
    result: dict[str, dict[str, ArmArrays]] = {SEEN: {}, UNSEEN: {}}
    if arms.locked_fraction:
        base = _arrays(config, config.learner)
        for mask in _masks(config, base):
            result[SEEN][_name_of_locks(mask)] = lock_joints(base, mask)
        for locked in arms.unseen_sets:
            mask = np.isin(np.arange(1, MAX_JOINTS + 1), locked)
            result[UNSEEN][_name_of_locks(mask)] = lock_joints(base, mask)
    for split, names in ((SEEN, arms.models), (UNSEEN, arms.evaluated)):
        for name in names:
            model = _model(arms, name)
            short = arm_name(model)
            if short in result[SEEN] or short in result[UNSEEN]:
                raise ValueError(f"arms: expected models and evaluated of different names, got {short!r} twice")
            result[split][short] = _arrays(config, model)
    if arms.random_fraction:
        drawn = jax.device_get(_random_arms(jax.random.split(jax.random.PRNGKey(_RANDOM_SEED), _RANDOM_ARMS)))
        for i in range(_RANDOM_ARMS):
            result[UNSEEN][f"random {i}"] = jax.tree.map(lambda x, i=i: x[i], drawn)
    return result


def with_one_learner(env: EnvConfig, model: str, locked: Sequence[int | str]) -> EnvConfig:
    """The environment of one learner with all else as in the environment of many arms.

    Args:
      env: the environment of a run of many arms.
      model: the learner, see `ArmConfig.model`.
      locked: its locked joints, by number or name.

    Raises:
      ValueError: there is no such arm, or a policy of many arms cannot move it.
    """
    learner = dataclasses.replace(_model(arms_config(env), model), locked=list(locked) or None)
    label = "-".join([env.name, arm_name(learner), *(["locked", *map(str, locked)] if locked else [])])
    config = dataclasses.replace(env, name=label, arms=None, learner=learner, physics="auto")
    masked_arrays(learner, config.limits, config.metric.links)
    return config


def arm_name(model: ArmConfig) -> str:
    """A short name of an arm of a file, for tables."""
    path = model.model.replace("\\", "/").rstrip("/").split("/")
    stem = path[-1].rsplit(".", 1)[0]
    return path[-2] if stem in ("robot", "scene") and len(path) > 1 else stem


def _changes(value: Any) -> str:
    """A setting, or the fields of a config that differ from their defaults."""
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return str(value)
    default = type(value)()
    names = (field.name for field in dataclasses.fields(value))
    return ", ".join(
        f"{name}={getattr(value, name)}" for name in names if getattr(value, name) != getattr(default, name)
    )


def _model(arms: ArmsConfig, name: str) -> ArmConfig:
    return ArmConfig(model=name, armature=arms.armature, damping=arms.damping)


def _arrays(config: EnvConfig, arm: ArmConfig) -> ArmArrays:
    return arm_arrays(build_arm(arm, config.limits, config.metric.links))


def _masks(config: EnvConfig, base: ArmArrays) -> np.ndarray:
    """The sets of locked joints that training draws from: none, and up to `most_locked`, without the unseen ones."""
    arms, joints = arms_config(config), int(np.sum(base.is_free))
    if arms.most_locked >= joints:
        raise ValueError(f"arms.most_locked: expected less than the learner's {joints} joints, got {arms.most_locked}")
    for locked in arms.unseen_sets:
        if locked[-1] > joints:
            raise ValueError(f"arms.unseen: the learner has {joints} joints, got joint {locked[-1]}")
        if len(set(locked)) >= joints:
            raise ValueError(f"arms.unseen: expected at least one of the learner's {joints} joints to move, got none")
    none = np.zeros((1, MAX_JOINTS))
    if not arms.most_locked:
        return none
    return np.concatenate([none, lock_masks(joints, arms.most_locked, arms.unseen_sets)])


def _name_of_locks(mask: np.ndarray) -> str:
    numbers = np.flatnonzero(mask) + 1
    return f"locked {'+'.join(map(str, numbers))}" if len(numbers) else "whole"
