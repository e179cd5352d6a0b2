"""Inverse kinematics of the expert's hand, for dragging it in the live view. Needs no viser."""

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from mimic.arms.embodiment import Embodiment
from mimic.arms.link_match import joint_transforms, link_ends

_EVALUATIONS = 40  # of the hand's position; some 0.2 ms each
_STAY = 1e-3  # chain lengths per radian: chooses among poses with the same hand


def hand_position(arm: Embodiment, qpos: Float[np.ndarray, " joints"]) -> Float[np.ndarray, "3"]:
    """End of the last link, in the base frame [m]."""
    return link_ends(arm, qpos)[-1, 1]


def pose_of_hand(
    arm: Embodiment, qpos: Float[np.ndarray, " joints"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " joints"]:
    """A pose near `qpos` [rad], within the joint ranges, whose hand is nearest to a position in the base frame [m].

    By SciPy's least squares within bounds (trust region reflective), also where the position is out of reach.
    """
    length, (lower, upper) = float(arm.chain_length), np.asarray(arm.joint_range, float).T
    start = np.clip(np.asarray(qpos, float), lower + 1e-9, upper - 1e-9)
    stay = _STAY * np.eye(arm.num_joints)

    def residuals(pose: np.ndarray) -> np.ndarray:
        return np.concatenate([(hand_position(arm, pose) - target) / length, _STAY * (pose - start)])

    def jacobian(pose: np.ndarray) -> np.ndarray:
        return np.concatenate([_jacobian(arm, pose) / length, stay])

    return least_squares(residuals, start, jacobian, bounds=(lower, upper), max_nfev=_EVALUATIONS).x


def _jacobian(arm: Embodiment, qpos: Float[np.ndarray, " joints"]) -> Float[np.ndarray, "3 joints"]:
    """Derivative of the hand's position by the joints that move it."""
    hand, columns = hand_position(arm, qpos), []
    movers = {arm.link_joint[-1]}  # of the last link
    while -1 not in movers:
        movers.add(arm.joint_parent[min(movers)])
    for joint, transform in enumerate(joint_transforms(arm, qpos)[1:]):
        axis = transform[:3, :3] @ np.asarray(arm.joint_axis)[joint]
        anchor = transform[:3, :3] @ np.asarray(arm.joint_anchor)[joint] + transform[:3, 3]
        moves = joint in movers
        columns.append(np.cross(axis, hand - anchor) if moves else np.zeros(3))
    return np.stack(columns, axis=1)
