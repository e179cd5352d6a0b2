"""Speeds that the joints of a learner need for its hands to move as those of the expert."""

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.link_match import hands_of_bodies
from mimic.control.clearance import body_poses
from mimic.retargeting.hand_target import Placement, matched_hands


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
    """Linear [m] and angular velocity [rad] of the hands for each joint's velocity, in the base frame."""
    return hands_and_jacobians(arm, qpos)[1]


def hands_and_jacobians(
    arm: Embodiment, qpos: Float[np.ndarray, "poses joints"]
) -> tuple[Float[np.ndarray, "poses hands 4 4"], Float[np.ndarray, "poses hands 6 joints"]]:
    """Poses of the hands, as of `hand_poses`, and what `hand_jacobians` returns, in double precision."""
    joint_axis, anchor = np.asarray(arm.joint_axis, float), np.asarray(arm.joint_anchor, float)
    rotations, shifts = body_poses(np.asarray(qpos, float), arm.joint_parent, joint_axis, anchor)
    poses = hands_of_bodies(arm, rotations, shifts)
    axes = (rotations[:, 1:] @ joint_axis[..., None])[..., 0]
    anchors = (rotations[:, 1:] @ anchor[..., None])[..., 0] + shifts[:, 1:]
    linear = np.cross(axes[:, None], poses[:, :, None, :3, 3] - anchors[:, None])
    turns = np.concatenate([linear, np.broadcast_to(axes[:, None], linear.shape)], axis=-1)
    moves = np.zeros((len(arm.hand_joint), arm.num_joints, 1))  # whether a joint moves a hand
    for hand, joint in enumerate(arm.hand_joint):
        while joint >= 0:
            moves[hand, joint], joint = 1.0, arm.joint_parent[joint]
    return poses, np.swapaxes(moves * turns, -1, -2)
