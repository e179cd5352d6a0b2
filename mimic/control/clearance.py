"""Frames and clearance of an arm by few operations on matrices, for a period of 1 ms.

`xp` is the array library of the arguments, `numpy` or `jax.numpy`. The constants are those of
`mimic.metric.matrix_kinematics` and `mimic.retargeting.clearance`.
"""

from typing import Any, NamedTuple

Array = Any


class FrameConstants(NamedTuple):
    """Of an arm, for `joint_frames`.

    Attributes:
      parent: of each joint, -1 at the base.
      constant: [16 joints] of the motions about the joints.
      factors: [2 joints, 16 joints] of the sines and then the cosines of the angles.
    """

    parent: Array
    constant: Array
    factors: Array


class ClearanceConstants(NamedTuple):
    """Of an arm, for `clearance`. Each of its pairs of capsules has the axes from p along u and from q along v.

    Attributes:
      parent, constant, factors: see `FrameConstants`.
      moved: [4 joints, 4 pairs + points] of which joint_frames @ moved + fixed are u, v, w = p - q and again u of all
        pairs, then the points whose height is checked [m].
      fixed: [3, 4 pairs + points].
      squared_v: [pairs] v.v [m^2].
      per_u, per_v: [pairs] the inverses of u.u and v.v, of spheres a large number [1/m^2].
      product: [pairs] u.u v.v [m^4].
      parallel: [pairs] below this determinant u and v are taken as parallel [m^4].
      radii: [pairs] sums of the radii [m].
      heights: [points] minimum heights [m].
    """

    parent: Array
    constant: Array
    factors: Array
    moved: Array
    fixed: Array
    squared_v: Array
    per_u: Array
    per_v: Array
    product: Array
    parallel: Array
    radii: Array
    heights: Array


def joint_frames(qpos: Array, constants: FrameConstants | ClearanceConstants, xp: Any) -> Array:
    """Motions of the joints' child bodies from the zero pose, [..., 3, 4 joints].

    They are the upper rows of homogeneous matrices in the base frame, side by side.

    Args:
      qpos: angles [..., joints] [rad].
      constants: of the arm.
      xp: array library.
    """
    joints, batch = qpos.shape[-1], qpos.shape[:-1]
    angles = xp.concatenate([xp.sin(qpos), xp.cos(qpos)], axis=-1)
    motions = (angles @ constants.factors + constants.constant).reshape(*batch, 4 * joints, 4)
    frames: list[Array] = []
    for joint, parent in enumerate(constants.parent):
        row = 4 * joint
        if parent < 0:
            frames.append(motions[..., row : row + 3, :])
        else:
            frames.append(frames[parent] @ motions[..., row : row + 4, :])
    return xp.concatenate(frames, axis=-1)


def moved_points(frames: Array, moved: Array, fixed: Array) -> Array:
    """Points and directions of an arm's bodies in a pose, [..., 3, points]: frames @ moved + fixed."""
    columns = frames.reshape(-1, frames.shape[-1]) @ moved  # of all poses in one product
    return columns.reshape(*frames.shape[:-1], moved.shape[-1]) + fixed


def clearance(qpos: Array, constants: ClearanceConstants, xp: Any) -> Array:
    """The clearance [...] [m] of an arm in poses [..., joints] [rad], negative where something touches.

    It is the minimum distance of the pairs of capsules, and of points from their minimum heights.

    Args:
      qpos: angles.
      constants: of the arm.
      xp: array library.
    """
    vectors = moved_points(joint_frames(qpos, constants, xp), constants.moved, constants.fixed)
    pairs = constants.radii.shape[-1]
    heights = vectors[..., 2, 4 * pairs :] - constants.heights
    distances = _pair_distances(vectors[..., : 4 * pairs], constants, xp)
    return xp.concatenate([distances, heights], axis=-1).min(axis=-1)


def _pair_distances(vectors: Array, constants: ClearanceConstants, xp: Any) -> Array:
    """Distances [..., pairs], as `mimic.retargeting.costs.segment_distance` computes those of the axes.

    Args:
      vectors: u, v, w and again u of the pairs, [..., 3, 4 pairs].
      constants: of the arm.
      xp: array library.
    """
    pairs = constants.radii.shape[-1]
    dots = _sum(vectors[..., : 3 * pairs] * vectors[..., pairs:])
    uv, vw, uw = dots[..., :pairs], dots[..., pairs : 2 * pairs], dots[..., 2 * pairs :]
    determinant = constants.product - uv * uv
    quotient = (uv * vw - constants.squared_v * uw) / xp.maximum(determinant, constants.parallel)
    s = xp.where(determinant <= constants.parallel, 0.5, quotient)
    s = _fraction(s, xp)
    t = _fraction((uv * s + vw) * constants.per_v, xp)
    s = _fraction((uv * t - uw) * constants.per_u, xp)
    t = _fraction((uv * s + vw) * constants.per_v, xp)
    u, v, w = vectors[..., :pairs], vectors[..., pairs : 2 * pairs], vectors[..., 2 * pairs : 3 * pairs]
    difference = w + s[..., None, :] * u - t[..., None, :] * v
    return xp.sqrt(_sum(difference * difference)) - constants.radii


def _sum(vectors: Array) -> Array:
    """The sum over the three components, [..., 3, columns]."""
    return vectors[..., 0, :] + vectors[..., 1, :] + vectors[..., 2, :]  # NumPy sums a short axis slowly


def _fraction(x: Array, xp: Any) -> Array:
    """The number in [0, 1] that is nearest."""
    return xp.minimum(xp.maximum(x, 0.0), 1.0)
