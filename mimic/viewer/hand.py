"""Inverse kinematics of the expert's hand, for dragging it in the live view. Needs no viser."""

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.link_match import joint_transforms, link_ends

_ITERATIONS, _CLOSE = 60, 1e-4  # chain lengths
_DAMPING = 0.03  # chain lengths; bounds the step near singular poses
_STEP = 0.2  # rad, maximum change of a joint in an iteration


def hand_position(arm: Embodiment, qpos: Float[np.ndarray, " joints"]) -> Float[np.ndarray, "3"]:
    """End of the last link, in the base frame [m]."""
    return link_ends(arm, qpos)[-1, 1]


def pose_of_hand(
    arm: Embodiment, qpos: Float[np.ndarray, " joints"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " joints"]:
    """A pose near `qpos` [rad], within the joint ranges, whose hand is at or near a position in the base frame [m].

    Damped least squares on the position (Wampler, 1986); a joint that a step would move beyond its range stops there.
    """
    length, (lower, upper) = float(arm.chain_length), np.asarray(arm.joint_range, float).T
    pose = np.clip(np.asarray(qpos, float), lower, upper)
    best, smallest = pose, np.inf
    for _ in range(_ITERATIONS):
        error = (target - hand_position(arm, pose)) / length
        if np.linalg.norm(error) < smallest:
            best, smallest = pose, float(np.linalg.norm(error))
        if smallest < _CLOSE:
            break
        jacobian = _jacobian(arm, pose) / length
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + _DAMPING**2 * np.eye(3), error)
        step *= min(1.0, _STEP / max(float(np.abs(step).max()), 1e-12))
        pose = np.clip(pose + step, lower, upper)
    return best


def _jacobian(arm: Embodiment, qpos: Float[np.ndarray, " joints"]) -> Float[np.ndarray, "3 joints"]:
    """Derivative of the hand's position by the joints that move it."""
    hand, columns = hand_position(arm, qpos), []
    for joint, transform in enumerate(joint_transforms(arm, qpos)[1:]):
        axis = transform[:3, :3] @ np.asarray(arm.joint_axis)[joint]
        anchor = transform[:3, :3] @ np.asarray(arm.joint_anchor)[joint] + transform[:3, 3]
        moves = joint <= arm.link_joint[-1]
        columns.append(np.cross(axis, hand - anchor) if moves else np.zeros(3))
    return np.stack(columns, axis=1)
