"""Motions to write as a dataset: rollouts of a policy, or what files have."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mimic.evaluation.evaluator import Evaluator, Rollouts
from mimic.evaluation.labels import SPLITS
from mimic.motions.demonstrations import Demonstrations
from mimic.motions.formats.episodes import ANGLE, TORQUE, VELOCITY, ArmMotions, Episodes

# What a policy commands, by `env.control`.
_COMMANDS = {"torque": TORQUE, "joint_position": ANGLE, "joint_velocity": VELOCITY}


def rollout_episodes(
    evaluator: Evaluator, rollouts: Rollouts, splits: Sequence[str], task: str, provenance: dict[str, Any]
) -> tuple[Episodes, int]:
    """The rollouts on the demonstrations of some splits, and the number of those that a runaway cut short.

    An episode ends before the step in which a joint exceeds the environment's speed bound. Episodes without a step are
    left out.
    """
    env, parts = evaluator.env, evaluator.parts
    horizon, demonstrations = env.config.horizon, env.demonstrations
    indices = {split: np.arange(demonstrations.count)[parts[split]] for split in SPLITS if split in splits}
    chosen = np.concatenate(list(indices.values()))
    labels = np.repeat(list(indices), [len(index) for index in indices.values()])
    numbers = np.concatenate([np.arange(len(index)) for index in indices.values()])
    start = np.asarray(env.start_poses if rollouts.start is None else rollouts.start)[chosen][:, None]
    qpos, qvel, command = (np.asarray(values)[chosen] for values in (rollouts.qpos, rollouts.qvel, rollouts.command))
    steps = steps_before_runaway(qvel, env.config.speed_bound)
    kept = np.flatnonzero(steps)
    learner = ArmMotions(
        env.learner.name,
        env.learner.joint_names,
        np.concatenate([start, qpos], axis=1)[kept],
        np.concatenate([np.zeros_like(start), qvel], axis=1)[kept],
        command[kept],
        _COMMANDS[env.config.control],
    )
    shown = demonstrations.of_length(horizon).select(chosen[kept].tolist())
    expert = _arm_motions(shown)
    task = task or f"imitate the motion of {env.expert.name} with {env.learner.name} ({env.config.name})"
    episodes = Episodes(
        env.config.control_dt, task, learner, expert, steps[kept].tolist(), labels[kept].tolist(),
        numbers[kept].tolist(), provenance,
    )  # fmt: skip
    return episodes, int(np.sum(steps < horizon))


def steps_before_runaway(qvel: np.ndarray, speed_bound: float) -> np.ndarray:
    """The steps [episodes] before the first one in which a joint reaches the speed bound or is not a number.

    Args:
      qvel: [episodes, steps, joints] after each step [rad/s].
      speed_bound: see `EnvConfig` [rad/s].
    """
    runaway = ~np.all(np.abs(qvel) < speed_bound, axis=-1)  # True for NaN too
    return np.where(runaway.any(axis=1), runaway.argmax(axis=1), qvel.shape[1])


def file_episodes(demonstrations: Demonstrations, task: str, provenance: dict[str, Any]) -> Episodes:
    """The motions of a file."""
    count, steps = demonstrations.count, [demonstrations.horizon] * demonstrations.count
    task, robot = task or f"move {demonstrations.arm}", _arm_motions(demonstrations)
    return Episodes(demonstrations.dt, task, robot, None, steps, ["train"] * count, range(count), provenance)


def _arm_motions(motions: Demonstrations) -> ArmMotions:
    return ArmMotions(
        motions.arm, motions.joint_names, motions.qpos, motions.qvel, motions.torque, TORQUE,
        motions.gripper, motions.gripper_names,
    )  # fmt: skip
