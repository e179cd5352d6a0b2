"""Speeds that the joints of a learner need for its hands to move as those of the expert."""

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.metric.kinematics import link_state_table
from mimic.retargeting.hand_target import Placement, matched_hands

_STEP = 1e-5  # rad, of the differences that give a hand's velocity


def speeds_needed(
    expert: Embodiment,
    learner: Embodiment,
    qpos: Float[np.ndarray, "poses joints"],
    qvel: Float[np.ndarray, "poses joints"],
    postures: Float[np.ndarray, "poses learner_joints"],
    base: Placement,
    limit: Float[np.ndarray, " learner_joints"],
    rotation: Float[np.ndarray, " poses"] | float = 1.0,
) -> Float[np.ndarray, " poses"]:
    """Speed of the fastest joint, as a fraction of its limit, with least squares of these fractions.

    Args:
      expert, learner: arms with hands.
      qpos, qvel: of the expert [rad, rad/s].
      postures: of the learner [rad].
      base: of the learner, one for each pose.
      limit: velocity limits of the learner [rad/s].
      rotation: 1 where the hand has the angular velocity of the expert's too, 0 where it has the linear one alone.
    """
    of_expert, of_learner = matched_hands(expert, learner).T
    twist = np.einsum("phrj,pj->phr", hand_jacobians(expert, qpos)[:, of_expert], qvel)
    twist = np.einsum("ikp,phri->phrk", base.rotation, twist.reshape(*twist.shape[:2], 2, 3)).reshape(twist.shape)
    counts = np.where(np.arange(6) < 3, 1.0, np.reshape(rotation, (-1, 1, 1)))
    scaled = counts[..., None] * hand_jacobians(learner, postures)[:, of_learner] * limit
    inverse = np.linalg.pinv(scaled.reshape(len(qpos), -1, learner.num_joints), rcond=1e-6)
    return np.abs(np.einsum("pjr,pr->pj", inverse, (counts * twist).reshape(len(qpos), -1))).max(axis=1)


def hand_jacobians(arm: Embodiment, qpos: np.ndarray) -> Float[np.ndarray, "poses hands 6 joints"]:
    """Linear [m] and angular velocity [rad] of the hands for each joint's velocity."""
    unit = np.eye(arm.num_joints)
    steps = np.asarray(qpos, float)[:, None, None] + _STEP * np.stack([-unit, unit], axis=1)
    moved = link_state_table(arm, steps, np.zeros_like(steps), float).hand
    here, speeds = np.broadcast_arrays(qpos[:, None].astype(float), unit)
    turned = link_state_table(arm, here, speeds, float).hand
    assert moved is not None and turned is not None
    linear = np.diff(moved.position, axis=2)[:, :, 0] * float(arm.chain_length) / (2 * _STEP)
    return np.moveaxis(np.concatenate([linear, turned.angular_velocity], axis=-1), 1, -1)
