"""Speeds that the joints of a learner need for its hands to move as those of the expert."""

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.base import spatial
from mimic.metric.kinematics import joint_axes, joint_frames
from mimic.retargeting.hand_target import Placement, hand_components, joint_line, matched_hands


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
    twist = np.einsum("phrj,pj->phr", hands_and_jacobians(expert, qpos)[1][:, of_expert], qvel)
    twist = np.einsum("ikp,phri->phrk", base.rotation, twist.reshape(*twist.shape[:2], 2, 3)).reshape(twist.shape)
    counts = np.where(np.arange(6) < 3, 1.0, np.reshape(rotation, (-1, 1, 1)))
    scaled = counts[..., None] * hands_and_jacobians(learner, postures)[1][:, of_learner] * limit
    inverse = np.linalg.pinv(scaled.reshape(len(qpos), -1, learner.num_joints), rcond=1e-6)
    return np.abs(np.einsum("pjr,pr->pj", inverse, (counts * twist).reshape(len(qpos), -1))).max(axis=1)


def hands_and_jacobians(
    arm: Embodiment, qpos: Float[np.ndarray, "poses joints"]
) -> tuple[Float[np.ndarray, "poses hands 4 4"], Float[np.ndarray, "poses hands 6 joints"]]:
    """Poses of the hands, as of `hand_poses`, and their Jacobians, in double precision.

    Jacobians: linear [m] and angular velocity [rad] of the hands for each joint's velocity, in the base frame.

    On scalar components, see `mimic.base.spatial`, which is six times as fast as matrices for a thousand poses.
    """
    frames = joint_frames(arm, [*np.asarray(qpos, float).T], None)
    axes, anchors = joint_axes(arm, frames), [frame.anchor for frame in frames[1:]]
    poses = np.zeros((len(qpos), len(arm.hand_joint), 4, 4)) + np.eye(4)
    jacobians = np.zeros((len(qpos), len(arm.hand_joint), 6, arm.num_joints))
    for hand, (position, rotation) in enumerate(hand_components(arm, frames)):
        for row in range(3):
            poses[:, hand, row, 3] = position[row]
            for column in range(3):
                poses[:, hand, row, column] = rotation[column][row]
        for joint in joint_line(arm, arm.hand_joint[hand]):
            linear = spatial.cross(axes[joint], spatial.subtract(position, anchors[joint]))
            for row, value in enumerate((*linear, *axes[joint])):
                jacobians[:, hand, row, joint] = value
    return poses, jacobians
