"""The clearance of an arm: how far its capsules are from each other and from the floor, by NumPy.

For optimisation `mimic.metric.capsule_distances` moves the capsules by JAX in scalar arithmetic: that is fast on GPUs,
but takes milliseconds on a CPU.
"""

from typing import Any, NamedTuple

import numpy as np

Array = Any
_TINY = 1e-12  # m^2, replaces the squared length of a capsule that is a sphere
_PARALLEL = 1e-6  # squared sine of an angle: float32 resolves no smaller angle
_FAR = 1e3  # m: the clearance of an arm of which nothing is checked


class ClearanceConstants(NamedTuple):
    """An arm with its capsules in the zero pose, in the base frame [m].

    Attributes:
      parent: [joints] of each joint, -1 at the base.
      axis, anchor: [joints, 3] unit axes, and a point on each.
      joint: [capsules] last joint that moves each capsule, -1 for the base.
      start, end: [capsules, 3] ends of their axes.
      radius: [capsules].
      pairs: [pairs, 2] capsules that are checked against each other.
      above: [checked] capsules whose height above the floor is checked.
      floor_height: of the floor.
    """

    parent: Array
    axis: Array
    anchor: Array
    joint: Array
    start: Array
    end: Array
    radius: Array
    pairs: Array
    above: Array
    floor_height: Array


def clearance(qpos: Array, arm: ClearanceConstants) -> Array:
    """The clearance [...] [m] of an arm in poses [..., joints] [rad], negative where something touches.

    It is the minimum distance of the pairs of capsules, and of capsules from the floor.

    Args:
      qpos: angles.
      arm: the arm.
    """
    start, end = capsule_axes(qpos, arm)
    distances = pair_distances(start, end, arm)
    lowest = np.minimum(start[..., arm.above, 2], end[..., arm.above, 2])
    heights = lowest - (arm.radius[arm.above] + arm.floor_height)
    nothing = np.full_like(qpos[..., :1], _FAR)
    return np.concatenate([distances, heights, nothing], axis=-1).min(axis=-1)


def pair_distances(start: Array, end: Array, arm: ClearanceConstants) -> Array:
    """Distances [..., pairs] of the pairs of capsules [m], negative where they intersect; see `capsule_axes`."""
    i, j = arm.pairs[:, 0], arm.pairs[:, 1]
    axes = start[..., i, :], end[..., i, :], start[..., j, :], end[..., j, :]
    return segment_distances(*axes, np) - (arm.radius[i] + arm.radius[j])


def capsule_axes(qpos: Array, arm: ClearanceConstants) -> tuple[Array, Array]:
    """Ends [..., capsules, 3] of the capsules' axes in poses [m]; see `clearance`."""
    rotations, shifts = body_poses(qpos, arm.parent, arm.axis, arm.anchor)
    body = arm.joint + 1
    rotation, shift = rotations[..., body, :, :], shifts[..., body, :]
    start, end = (np.einsum("...cij,cj->...ci", rotation, points) + shift for points in (arm.start, arm.end))
    return start, end


def body_poses(qpos: Array, parent: Array, axis: Array, anchor: Array) -> tuple[Array, Array]:
    """Rotations [..., bodies, 3, 3] and shifts [..., bodies, 3] [m] of an arm's bodies from the zero pose.

    The base comes first, then the body of each joint: a point p of the zero pose moves to rotation p + shift.

    Args:
      qpos: [..., joints] angles [rad].
      parent, axis, anchor: of the joints, see `ClearanceConstants`.
    """
    batch, identity = qpos.shape[:-1], np.eye(3, dtype=axis.dtype)
    rotations = [np.broadcast_to(identity, (*batch, 3, 3))]
    shifts = [np.broadcast_to(0 * identity[0], (*batch, 3))]
    angle, cross = qpos[..., None, None], np.cross(identity, axis[:, None])  # cross @ x: product of axis and x
    turns = identity + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
    steps = anchor[..., None] - turns @ anchor[..., None]
    for joint, before in enumerate(np.asarray(parent).tolist()):
        rotation = rotations[before + 1]
        shifts.append(shifts[before + 1] + (rotation @ steps[..., joint, :, :])[..., 0])
        rotations.append(rotation @ turns[..., joint, :, :])
    return np.stack(rotations, axis=-3), np.stack(shifts, axis=-2)


def segment_distances(a: Array, b: Array, c: Array, d: Array, xp: Any, smoothing: float = 0.0) -> Array:
    """Distances [...] of the line segments a-b and c-d (Ericson 2005, section 5.1.9).

    Args:
      a, b, c, d: [..., 3] ends [m].
      xp: array library, `numpy` or `jax.numpy`.
      smoothing: the distance of segments that cross [m], where its gradient is then 0.
    """
    u, v, w = b - a, d - c, a - c
    uu, vv, uv, uw, vw = (_dot(x, y) for x, y in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    determinant = uu * vv - uv * uv
    is_parallel = determinant <= _PARALLEL * uu * vv
    s = xp.where(is_parallel, 0.5, (uv * vw - vv * uw) / xp.where(is_parallel, 1, determinant))
    s = xp.clip(s, 0, 1)
    t = xp.clip((uv * s + vw) / xp.maximum(vv, _TINY), 0, 1)
    s = xp.clip((uv * t - uw) / xp.maximum(uu, _TINY), 0, 1)
    t = xp.clip((uv * s + vw) / xp.maximum(vv, _TINY), 0, 1)
    difference = w + s[..., None] * u - t[..., None] * v
    return xp.sqrt(_dot(difference, difference) + smoothing**2)


def _dot(x: Array, y: Array) -> Array:
    """The scalar products of vectors [..., 3]."""
    return x[..., 0] * y[..., 0] + x[..., 1] * y[..., 1] + x[..., 2] * y[..., 2]  # NumPy sums a short axis slowly
