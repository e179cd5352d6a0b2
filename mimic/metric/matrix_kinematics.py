"""Link states of an arm by few operations on matrices, for ONNX graphs that run in a fraction of a millisecond.

`mimic.metric.kinematics` computes the same in scalar arithmetic: that is fast on GPUs, but a graph of hundreds of nodes
takes a millisecond.
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.embodiment import Embodiment
from mimic.control.clearance import FrameConstants, joint_frames, moved_points

# Rows of a cross product: a x b = _SIGNS @ ((_LEFT @ a) * (_RIGHT @ b)).
_NEXT, _LAST = np.eye(3, dtype=np.float32)[[1, 2, 0]], np.eye(3, dtype=np.float32)[[2, 0, 1]]
_LEFT, _RIGHT = np.concatenate([_NEXT, _LAST]), np.concatenate([_LAST, _NEXT])
_SIGNS = np.concatenate([np.eye(3), -np.eye(3)], axis=1).astype(np.float32)
_ON_AXIS = 1e-9  # m, or a fraction of a direction


def frame_constants(arm: Embodiment) -> FrameConstants:
    """The constants of `joint_frames` for an arm.

    A joint's motion is I + sin(q) A + (1 - cos(q)) A A with the matrix A of the cross product with its axis, and a
    shift that keeps its anchor where it is.
    """
    joints = arm.num_joints
    constant, sine, cosine = np.zeros((joints, 4, 4)) + np.eye(4), *np.zeros((2, joints, joints, 4, 4))
    for joint, (axis, anchor) in enumerate(zip(arm.joint_axis, arm.joint_anchor, strict=True)):
        x, y, z = axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        for matrix, part in (
            (sine[joint, joint], cross),
            (cosine[joint, joint], -cross @ cross),
            (constant[joint], cross @ cross),
        ):
            matrix[:3, :3] += part
            matrix[:3, 3] -= part @ anchor
    factors = np.concatenate([sine, cosine]).reshape(2 * joints, -1)
    return FrameConstants(np.array(arm.joint_parent), constant.ravel().astype(np.float32), factors.astype(np.float32))


def point_columns(
    arm: Embodiment, joints: Sequence[int], vectors: Float[np.ndarray, "points 4"]
) -> tuple[Float[np.ndarray, "columns points"], Float[np.ndarray, "3 points"]]:
    """The matrices `moved` and `fixed` of `mimic.control.clearance.moved_points`.

    Args:
      arm: the embodiment.
      joints: of the body of each, -1 for the base.
      vectors: in the zero pose, in the base frame; homogeneous, so the fourth number is 1 for a point and 0 for a
        direction.
    """
    moved = np.zeros((4 * arm.num_joints, len(joints)), np.float32)
    fixed = np.zeros((3, len(joints)), np.float32)
    for column, (joint, vector) in enumerate(zip(joints, vectors, strict=True)):
        if joint < 0:
            fixed[:, column] = vector[:3]
        else:
            moved[4 * joint : 4 * joint + 4, column] = vector
    return moved, fixed


def make_link_vector(
    arm: Embodiment,
) -> Callable[[Float[Array, " joints"], Float[Array, " joints"]], Float[Array, " numbers"]]:
    """Makes the function from joint angles and velocities [rad, rad/s] to the numbers of `kinematics.link_states`.

    They are the normalized positions of all links, then their directions, linear and angular velocities.

    Args:
      arm: the embodiment.
    """
    links, joints = arm.num_links, arm.num_joints
    constants, bodies = frame_constants(arm), [*arm.link_joint] * 2 + [*range(joints)] * 2
    parts = ((arm.link_position, 1), (arm.link_rotation[:, :, 0], 0), (arm.joint_axis, 0), (arm.joint_anchor, 1))
    vectors = np.concatenate([np.c_[x, np.full(len(x), homogeneous)] for x, homogeneous in parts])
    # What does not move has a tiny deviation in a policy's statistics, which would magnify rounding.
    bodies = [_carrier(arm, joint, vector) for joint, vector in zip(bodies, vectors, strict=True)]
    moved, fixed = point_columns(arm, bodies, vectors)
    ends = np.cumsum([links, links, joints])
    moves = _moves(arm)
    # v_i = omega_i x p_i + sum_j a_j x omega_j, of the joints j with anchors a_j that move link i.
    sums = np.concatenate([np.eye(links, dtype=np.float32), moves])
    unit = np.float32(1 / arm.chain_length)

    def link_vector(qpos: Float[Array, " joints"], qvel: Float[Array, " joints"]) -> Float[Array, " numbers"]:
        points = moved_points(joint_frames(qpos, constants, jnp), moved, fixed)
        position, direction, axis, anchor = jnp.split(points, ends, axis=1)
        of_joints = axis * qvel
        angular = of_joints @ moves
        left, right = jnp.concatenate([angular, anchor], axis=1), jnp.concatenate([position, of_joints], axis=1)
        linear = _SIGNS @ ((_LEFT @ left) * (_RIGHT @ right)) @ sums
        return jnp.concatenate([unit * position, direction, unit * linear, angular], axis=1).T.ravel()

    return link_vector


def _carrier(arm: Embodiment, joint: int, vector: np.ndarray) -> int:
    """The last joint that moves a homogeneous vector of a joint's body: a joint does not move what is on its axis."""
    while joint >= 0:
        arm_of_rotation = vector[:3] - vector[3] * arm.joint_anchor[joint]
        if np.abs(np.cross(arm.joint_axis[joint], arm_of_rotation)).max() > _ON_AXIS:
            break
        joint = arm.joint_parent[joint]
    return joint


def _moves(arm: Embodiment) -> np.ndarray:
    """Whether each joint moves each link, [joints, links], as numbers."""
    moves = np.zeros((arm.num_joints, arm.num_links), np.float32)
    for link, joint in enumerate(arm.link_joint):
        while joint >= 0:
            moves[joint, link], joint = 1.0, arm.joint_parent[joint]
    return moves
