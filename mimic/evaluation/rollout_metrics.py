"""Metrics of rollouts, one row for each demonstration: accuracy, similarity, smoothness and limit violations."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float

from mimic.arms.arrays import ArmArrays
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import pose_limits
from mimic.metric.kinematics import LinkStates
from mimic.metric.similarity import CentreLine, centre_line, centre_line_table, similarity
from mimic.retargeting.pose_baselines import baseline_poses

if TYPE_CHECKING:  # imports brax and MJX, which pose mappers do not need
    from mimic.envs.imitation import ImitationEnv

Table = dict[str, Float[np.ndarray, " demonstrations"]]
WORST = 3  # number of the worst demonstrations of each split in a report
_RESAMPLES = 2000  # of the bootstrap
MIN_SPAN = 0.25  # of the distance of holding the start pose, that a best motion must save for a gap to mean something
_ROUNDING = 1e-5  # float32 error of a torque at its limit (relative), or of a joint at the end of its range (rad)


# Above 40 lines because of its docstring.
def measure(
    env: "ImitationEnv",
    learner: LinkStates,
    qpos: Float[np.ndarray, "demonstrations time joints"],
    qvel: Float[np.ndarray, "demonstrations time joints"],
    torque: Float[np.ndarray, "demonstrations time joints"],
) -> Table:
    """Computes the columns of a table with one row for each demonstration; means over time, joints and links.

    - `link_angle_error_deg`: angle between each learner link and its corresponding expert links, weighted by W;
      `link_angle_error_deg.LINK` is that of one link.
    - `angular_velocity_error`: the same for the links' angular velocities [rad/s], norm of the difference.
    - `torque_rms`: root mean square of the torque, as a fraction of the maximum.
    - `torque_change`: root mean square of the torque's change between steps, as a fraction of the maximum.
    - `torque_saturation`: fraction of the steps in which a torque is at its maximum.
    - `position_violations`, `speed_violations`, `torque_violations`: number of steps in which a joint exceeds its range
      (if that is less than a full rotation), its velocity limit, or its torque limit.

    Args:
      env: the environment with these demonstrations.
      learner: link states after each step, [demonstrations, time, links, 3].
      qpos: learner's joint angles after each step [rad].
      qvel: its joint velocities after each step [rad/s].
      torque: constant torque in each step [N m].
    """
    arm = env.learner
    fractions = env.config.metric.link_fractions(env.expert, arm)
    states = env.expert_states
    direction, angular_velocity = (
        np.asarray(x)[:, 1 : qpos.shape[1] + 1] for x in (states.direction, states.angular_velocity)
    )
    cosine = np.einsum("dtix,dtjx->dtij", direction, np.asarray(learner.direction))
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean(axis=1)
    by_link = (angle * fractions).sum(axis=1)
    difference = angular_velocity[:, :, :, None] - np.asarray(learner.angular_velocity)[:, :, None]
    velocity_error = (np.linalg.norm(difference, axis=-1).mean(axis=1) * fractions).sum(axis=1)
    relative = torque / np.asarray(env.torque_scale)
    change = np.diff(relative, axis=1)
    return {
        "link_angle_error_deg": by_link.mean(axis=1),
        **{f"link_angle_error_deg.{name}": by_link[:, i] for i, name in enumerate(arm.link_names)},
        "angular_velocity_error": velocity_error.mean(axis=1),
        "torque_rms": np.sqrt((relative**2).mean(axis=(1, 2))),
        "torque_change": np.sqrt((change**2).mean(axis=(1, 2))) if change.size else np.zeros(len(qpos)),
        "torque_saturation": (np.abs(relative) > 0.99).any(axis=-1).mean(axis=1),
        **_violations(arm, qpos, qvel, torque),
    }


def _violations(arm: Embodiment, qpos: np.ndarray, qvel: np.ndarray, torque: np.ndarray) -> Table:
    """Number of steps in which a joint exceeds a limit."""
    lower, upper = pose_limits(arm, float)
    within = {  # False for NaN, after a runaway
        "position": (qpos >= lower - _ROUNDING) & (qpos <= upper + _ROUNDING),
        "speed": np.abs(qvel) <= np.asarray(arm.velocity_limit) * (1 + _ROUNDING),
        "torque": np.abs(torque) <= np.asarray(arm.torque_limit) * (1 + _ROUNDING),
    }
    return {f"{name}_violations": (~flags.all(axis=-1)).sum(axis=1) for name, flags in within.items()}


def speed_violations(arms: ArmArrays, qvel: Float[np.ndarray, "rows time joints"]) -> Float[np.ndarray, " rows"]:
    """Fraction of the steps after which a joint exceeds its velocity limit, for the arm of each row."""
    limit = np.asarray(arms.velocity_limit)[:, None] * np.float32(1 + _ROUNDING)
    is_slow = np.abs(qvel) <= limit  # False for NaN too
    return (~is_slow & (np.asarray(arms.is_free)[:, None] > 0)).any(axis=-1).mean(axis=1)


centre_lines = jax.jit(jax.vmap(centre_line))  # of the arm of each row; compiled once for all tables of a report


def measure_similarity(
    expert: CentreLine, learner: Embodiment | ArmArrays, qpos: Float[np.ndarray, "demonstrations time joints"]
) -> Table:
    """Computes the columns of the measures of `mimic.metric.similarity`, means over time.

    Args:
      expert: centre lines of the demonstrations, [demonstrations, time, samples, 3].
      learner: the learner, or the arm of each row.
      qpos: its joint angles at the same times [rad].
    """
    if isinstance(learner, ArmArrays):
        line = jax.device_get(centre_lines(learner, qpos))
    else:
        line = centre_line_table(learner, qpos)
    return {name: value.mean(axis=1, dtype=float) for name, value in similarity(expert, line).items()}


def means_by_split(tables: Mapping[str, Table], parts: Mapping[str, slice]) -> dict[str, dict[str, dict[str, float]]]:
    """Means of the columns of tables over the splits of their rows, as {table: {column: {split: mean}}}."""
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
    """Mean similarity of poses of the learner, and of the baselines' poses, as {method: {column: {split: mean}}}.

    Args:
      expert: embodiment with n joints.
      learner: embodiment with n_hat joints.
      expert_qpos: poses of the expert [rad].
      poses: poses of the learner at the same times [rad], by method.
      split: name of the split that all of these poses belong to.
    """
    expert_qpos = np.asarray(expert_qpos, np.float32)
    line = centre_line_table(expert, expert_qpos)
    poses = {**poses, **baseline_poses(expert, learner, expert_qpos)}
    tables = {name: measure_similarity(line, learner, np.asarray(qpos, np.float32)) for name, qpos in poses.items()}
    return means_by_split(tables, {split: slice(None)})


def gaps(distance: Any, bound: Any, hold: Any) -> Any:
    """Optimality gap of distances (numbers or arrays): 0 at the kinematic bound, 1 at holding the start pose.

    It is NaN where `has_gap` is False.
    """
    distance, bound, hold = (np.asarray(x, float) for x in (distance, bound, hold))
    meaningful = has_gap(bound, hold)
    return np.where(meaningful, (distance - bound) / np.where(meaningful, hold - bound, 1.0), np.nan)


def gap_interval(
    distance: Float[np.ndarray, "seeds demonstrations"],
    bound: Float[np.ndarray, " demonstrations"],
    hold: Float[np.ndarray, " demonstrations"],
) -> tuple[float, float, float]:
    """The optimality gap of mean distances, and its 95 % interval by a hierarchical bootstrap (percentiles).

    Each resample draws seeds of the training, and for all of them demonstrations, both with replacement.

    Args:
      distance: mean distance of each demonstration with the policy of each seed.
      bound: its kinematic bound.
      hold: its distance of holding the start pose.

    Returns:
      Gap, and the ends of the interval; NaN where there is no gap.
    """
    rng = np.random.default_rng(0)
    seeds, count = distance.shape
    chosen_seeds = rng.integers(seeds, size=(_RESAMPLES, seeds))
    chosen = rng.integers(count, size=(_RESAMPLES, count))
    # The number of times that each is drawn, in place of the drawn values: memory does not grow with their product.
    by_seed = (chosen_seeds[:, :, None] == np.arange(seeds)).mean(axis=1)
    by_demonstration = np.stack([np.bincount(row, minlength=count) for row in chosen]) / count
    distances = np.einsum("rs,sd,rd->r", by_seed, distance, by_demonstration)
    resampled = gaps(distances, by_demonstration @ bound, by_demonstration @ hold)
    low, high = np.nanquantile(resampled, [0.025, 0.975]) if np.isfinite(resampled).any() else (np.nan, np.nan)
    return float(gaps(distance.mean(), bound.mean(), hold.mean())), float(low), float(high)


def has_gap(bound: Any, hold: Any) -> Any:
    """Whether the kinematic bound is clearly below the distance of holding the start pose.

    Otherwise the optimality gap divides by almost zero, and small motions that the learner cannot follow have gaps of
    hundreds of percent.
    """
    bound, hold = np.asarray(bound), np.asarray(hold)
    return (bound <= (1 - MIN_SPAN) * hold) & (hold > 0)
