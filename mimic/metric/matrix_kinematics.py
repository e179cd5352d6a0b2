"""Constants of the frames and points of an arm, as matrices: for `mimic.control.clearance`, in NumPy on a robot."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.control.clearance import FrameConstants


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
