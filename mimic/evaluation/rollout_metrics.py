"""What is measured on each demonstration: how near, how alike, how smooth, and within which limits a learner moves."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.metric.kinematics import LinkStates
from mimic.metric.similarity import CentreLine, centre_line_table, similarity
from mimic.retargeting.pose import pose_limits
from mimic.retargeting.pose_baselines import baseline_poses

if TYPE_CHECKING:  # brax and MJX, which pose mappers need not
    from mimic.envs.imitation import ImitationEnv

Table = dict[str, Float[np.ndarray, " demonstrations"]]
WORST = 3  # demonstrations of each split that are named
MIN_SPAN = 0.25  # of the distance of holding the start pose, that a best motion must save for a gap to mean something
_ROUNDING = 1e-5  # what float32 leaves of a torque at its limit, or of a joint at its stop; relative and in rad


def measure(
    env: "ImitationEnv",
    learner: LinkStates,
    qpos: Float[np.ndarray, "demonstrations time joints"],
    qvel: Float[np.ndarray, "demonstrations time joints"],
    torque: Float[np.ndarray, "demonstrations time joints"],
) -> Table:
    """Columns of a table with one row for each demonstration; means over time, joints and links.

    - `link_angle_error_deg`: angle of each learner link to the expert links that correspond to it, by their share in W;
      `link_angle_error_deg.LINK` for each link.
    - `angular_velocity_error`: the same for the links' angular velocities [rad/s], length of the difference.
    - `torque_rms`: torque as a share of the largest one.
    - `torque_change`: change of the torque from step to step, likewise; 0 is smooth.
    - `torque_saturation`: share of the steps with a torque at its largest.
    - `position_violations`, `speed_violations`, `torque_violations`: steps with a joint beyond its range (if that is
      less than a full turn), its rated speed, or its torque limit.

    Args:
      env: with the demonstrations that were imitated.
      learner: link states after each step, [demonstrations, time, links, 3].
      qpos: learner's joint angles after each step [rad].
      qvel: its velocities [rad/s].
      torque: that was held in each step [N m].
    """
    arm = env.learner
    shares = env.config.metric.link_fractions(env.expert, arm)
    expert = {key: np.asarray(value)[:, 1 : qpos.shape[1] + 1] for key, value in vars(env.expert_states).items()}
    cosine = np.einsum("dtix,dtjx->dtij", expert["direction"], np.asarray(learner.direction))
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean(axis=1)
    by_link = (angle * shares).sum(axis=1)
    turning = expert["angular_velocity"][:, :, :, None] - np.asarray(learner.angular_velocity)[:, :, None]
    relative = torque / np.asarray(env.torque_scale)
    change = np.diff(relative, axis=1)
    lower, upper = pose_limits(arm, float)
    within = {  # what is not a number, after a runaway, is within nothing
        "position": (qpos >= lower - _ROUNDING) & (qpos <= upper + _ROUNDING),
        "speed": np.abs(qvel) <= np.asarray(arm.velocity_limit) * (1 + _ROUNDING),
        "torque": np.abs(torque) <= np.asarray(arm.torque_limit) * (1 + _ROUNDING),
    }
    return {
        "link_angle_error_deg": by_link.mean(axis=1),
        **{f"link_angle_error_deg.{name}": by_link[:, i] for i, name in enumerate(arm.link_names)},
        "angular_velocity_error": (np.linalg.norm(turning, axis=-1).mean(axis=1) * shares).sum(axis=1).mean(axis=1),
        "torque_rms": np.sqrt((relative**2).mean(axis=(1, 2))),
        "torque_change": np.sqrt((change**2).mean(axis=(1, 2))) if change.size else np.zeros(len(qpos)),
        "torque_saturation": (np.abs(relative) > 0.99).any(axis=-1).mean(axis=1),
        **{f"{name}_violations": (~flags.all(axis=-1)).sum(axis=1) for name, flags in within.items()},
    }


def measure_similarity(
    expert: CentreLine, learner: Embodiment, qpos: Float[np.ndarray, "demonstrations time joints"]
) -> Table:
    """Columns of the measures of `mimic.metric.similarity`, means over time.

    Args:
      expert: centre lines of the demonstrations, [demonstrations, time, samples, 3].
      learner: the arm.
      qpos: its joint angles at the same times [rad].
    """
    values = similarity(expert, centre_line_table(learner, qpos))
    return {name: value.mean(axis=1, dtype=float) for name, value in values.items()}


def means_by_split(tables: Mapping[str, Table], parts: Mapping[str, slice]) -> dict[str, dict[str, dict[str, float]]]:
    """Means of each column of each table over each split of its rows: {table: {column: {split: mean}}}."""
    return {
        name: {
            column: {split: float(values[part].mean()) for split, part in parts.items()}
            for column, values in table.items()
        }
        for name, table in tables.items()
    }


def pose_similarity(
    expert: Embodiment,
    learner: Embodiment,
    expert_qpos: Float[np.ndarray, "motions time joints"],
    poses: Mapping[str, Float[np.ndarray, "motions time learner_joints"]],
    *,
    split: str = "all",
) -> dict[str, dict[str, dict[str, float]]]:
    """Mean similarity of the learner's poses by name, and of the baselines beside them.

    Args:
      expert: n joints.
      learner: n_hat joints.
      expert_qpos: its poses [rad].
      poses: the learner's at the same times [rad], by what moves it.
      split: what all of these poses are called.
    """
    expert_qpos = np.asarray(expert_qpos, np.float32)
    line = centre_line_table(expert, expert_qpos)
    poses = {**poses, **baseline_poses(expert, learner, expert_qpos)}
    tables = {name: measure_similarity(line, learner, np.asarray(qpos, np.float32)) for name, qpos in poses.items()}
    return means_by_split(tables, {split: slice(None)})


def gaps(distance: Any, bound: Any, hold: Any) -> Any:
    """Optimality gap of distances, numbers or arrays: 0 at the kinematic bound, 1 at holding the start pose.

    NaN where `has_gap` says that it would mean nothing.
    """
    distance, bound, hold = (np.asarray(x, float) for x in (distance, bound, hold))
    meaningful = has_gap(bound, hold)
    return np.where(meaningful, (distance - bound) / np.where(meaningful, hold - bound, 1.0), np.nan)


def has_gap(bound: Any, hold: Any) -> Any:
    """Whether the best motion is clearly nearer than holding the start pose.

    Else the optimality gap divides by next to nothing, and small motions that the learner cannot follow at all give
    gaps of hundreds of percent.
    """
    bound, hold = np.asarray(bound), np.asarray(hold)
    return (bound <= (1 - MIN_SPAN) * hold) & (hold > 0)
