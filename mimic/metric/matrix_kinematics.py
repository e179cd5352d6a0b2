"""Link states of an arm by few operations on matrices, for ONNX graphs that run in a fraction of a millisecond.

`mimic.metric.kinematics` computes the same in scalar arithmetic: that is fast on GPUs, but a graph of hundreds of nodes
takes a millisecond.
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.embodiment import Embodiment
from mimic.control.clearance import FrameConstants

# Parts of the matrices of `_motion_factors`: the motion, its rate of change and the angular velocity.
_MOTION, _RATE, _ANGULAR, _SIZE = slice(0, 4), slice(4, 8), 8, 9
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
    joints, parents = arm.num_joints, arm.joint_parent
    factors, constant = _motion_factors(arm)
    columns, fixed = _state_columns(arm)

    def link_vector(qpos: Float[Array, " joints"], qvel: Float[Array, " joints"]) -> Float[Array, " numbers"]:
        sine, cosine = jnp.sin(qpos), jnp.cos(qpos)
        angles = jnp.concatenate([sine, cosine, qvel * sine, qvel * cosine, qvel])
        motions = jnp.split((angles @ factors + constant).reshape(-1, _SIZE), joints)
        states: list[Array] = []
        for motion, parent in zip(motions, parents, strict=True):
            states.append(motion[:, :3] if parent < 0 else motion @ states[parent])
        return (jnp.matmul(columns, jnp.concatenate(states)) + fixed).ravel()

    return link_vector


def _motion_factors(arm: Embodiment) -> tuple[Float[np.ndarray, "inputs numbers"], Float[np.ndarray, " numbers"]]:
    """Of the joints' matrices, which a chain of products takes from the base to the tip, one below the other.

    The motion P of a body, its rate of change Q and its angular velocity u follow from those of its parent by the
    product [P Q u] [[M N w], [0 M 0], [0 0 1]], with the motion M of the joint, its rate of change N, and its axis
    times its velocity w. All are transposed here. The first three columns are the state of a body on the base.

    Returns:
      factors, constant: inputs @ factors + constant are the numbers of all matrices. The inputs are sin(q), cos(q),
      v sin(q), v cos(q) and v for the angles q and velocities v of all joints.
    """
    joints, frames = arm.num_joints, frame_constants(arm)
    sine, cosine = frames.factors.reshape(2, joints, joints, 4, 4)
    constant, factors = np.zeros((joints, _SIZE, _SIZE)), np.zeros((5, joints, joints, _SIZE, _SIZE))
    constant[:, _MOTION, _MOTION] = constant[:, _RATE, _RATE] = frames.constant.reshape(joints, 4, 4)
    constant[:, _ANGULAR, _ANGULAR] = 1
    for part, matrix in ((0, sine), (1, cosine)):
        factors[part, :, :, _MOTION, _MOTION] = factors[part, :, :, _RATE, _RATE] = matrix
    factors[2, :, :, _MOTION, _RATE], factors[3, :, :, _MOTION, _RATE] = -cosine, sine
    for joint, axis in enumerate(arm.joint_axis):
        factors[4, joint, joint, :3, _ANGULAR] = axis
    factors, constant = factors.swapaxes(-1, -2).reshape(5 * joints, -1), constant.swapaxes(-1, -2).ravel()
    return factors.astype(np.float32), constant.astype(np.float32)


def _state_columns(arm: Embodiment) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows 3"]]:
    """The link states [rows, 3] are columns @ the joints' states + fixed; rows are in the order of `link_states`."""
    links, unit = arm.num_links, 1 / arm.chain_length
    columns, fixed = np.zeros((4, links, arm.num_joints, _SIZE)), np.zeros((4, links, 3))
    for link, joint in enumerate(arm.link_joint):
        position, direction = np.append(arm.link_position[link], 1), np.append(arm.link_rotation[link, :, 0], 0)
        # What does not move has a tiny deviation in a policy's statistics, which would magnify rounding.
        for row, part, vector, factor in (
            (0, _MOTION, position, unit),
            (1, _MOTION, direction, 1),
            (2, _RATE, position, unit),
        ):
            carrier = _carrier(arm, joint, vector)
            if carrier >= 0:
                columns[row, link, carrier, part] = factor * vector
            elif part == _MOTION:
                fixed[row, link] = factor * vector[:3]
        if joint >= 0:
            columns[3, link, joint, _ANGULAR] = 1
    shape = (4 * links, -1)
    return columns.reshape(shape).astype(np.float32), fixed.reshape(shape).astype(np.float32)


def _carrier(arm: Embodiment, joint: int, vector: np.ndarray) -> int:
    """The last joint that moves a homogeneous vector of a joint's body: a joint does not move what is on its axis."""
    while joint >= 0:
        arm_of_rotation = vector[:3] - vector[3] * arm.joint_anchor[joint]
        if np.abs(np.cross(arm.joint_axis[joint], arm_of_rotation)).max() > _ON_AXIS:
            break
        joint = arm.joint_parent[joint]
    return joint
