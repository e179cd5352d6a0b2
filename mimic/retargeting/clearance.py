"""The clearance of an arm by few operations on matrices, for an ONNX graph that runs within a period of 1 ms.

`mimic.retargeting.costs` computes the same distances for optimisation, in scalar arithmetic: that is fast on GPUs, but
a graph of thousands of nodes takes milliseconds.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.retargeting.costs import changing_pairs

_TINY = 1e-12  # m^2, replaces the squared length of a capsule that is a sphere
_PARALLEL = 1e-6  # of the squared sine of an angle: float32 resolves no smaller angle
_FAR = 1e3  # m, clearance of an arm without pairs, and height of capsules that stay at the base


def make_clearance(
    arm: Embodiment, capsules: Capsules, floor_height: float = 0.0
) -> Callable[[Float[Array, " joints"]], Float[Array, "1"]]:
    """Makes the function from joint angles [rad] to the clearance [m] of an arm, negative where something touches.

    It is the minimum distance of the capsules' pairs that joints change, and of the capsules from the floor, except
    those on the base and on the joints at the base.

    Args:
      arm: the embodiment.
      capsules: from `fit_capsules`, of the same arm.
      floor_height: height of the floor in the base frame [m].
    """
    screws = [np.asarray(part, np.float32) for part in _screws(arm)]
    by_joint = [np.flatnonzero(np.array(capsules.joint) == joint) for joint in range(-1, arm.num_joints)]
    order = np.concatenate(by_joint)
    points = [_ends(capsules, indices) for indices in by_joint]
    pairs = np.array(capsules.pairs, int).reshape(-1, 2)[changing_pairs(arm, capsules)]
    selection, constants = _pair_constants(capsules, pairs, order)
    height = np.where(np.array(capsules.near_base), -_FAR, capsules.radius + floor_height)[order]
    heights = np.concatenate([height, height]).astype(np.float32)

    def clearance(qpos: Float[Array, " joints"]) -> Float[Array, "1"]:
        ends = _moved(arm, screws, points, qpos)
        lowest = jnp.min(ends[2] - heights)
        if not len(pairs):
            return lowest[None]
        return jnp.minimum(jnp.min(_pair_distances(ends @ selection, constants)), lowest)[None]

    return clearance


def _screws(arm: Embodiment) -> tuple[np.ndarray, np.ndarray]:
    """Matrices [joints, 4, 4] of which I + sin(q) A + (1 - cos q) B is the motion about a joint's axis, in the base."""
    sine, cosine = np.zeros((2, arm.num_joints, 4, 4))
    for joint, (axis, anchor) in enumerate(zip(arm.joint_axis, arm.joint_anchor, strict=True)):
        x, y, z = axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        for matrix, part in ((sine, cross), (cosine, cross @ cross)):
            matrix[joint, :3, :3], matrix[joint, :3, 3] = part, -part @ anchor
    return sine, cosine


def _ends(capsules: Capsules, indices: np.ndarray) -> np.ndarray:
    """Homogeneous starts and then ends of some capsules, [4, 2 capsules]."""
    ends = np.concatenate([np.asarray(capsules.start)[indices], np.asarray(capsules.end)[indices]]).reshape(-1, 3)
    return np.concatenate([ends, np.ones((len(ends), 1))], axis=1).T.astype(np.float32)


def _moved(arm: Embodiment, screws: list[np.ndarray], points: list[np.ndarray], qpos: Array) -> Array:
    """Starts of all capsules and then their ends in a pose, [4, 2 capsules], in the order of their joints."""
    sine, cosine = screws
    angle = qpos[:, None, None]
    motions = np.eye(4, dtype=np.float32) + jnp.sin(angle) * sine + (1 - jnp.cos(angle)) * cosine
    frames: list[Array] = []
    for joint, parent in enumerate(arm.joint_parent):
        frames.append(motions[joint] if parent < 0 else frames[parent] @ motions[joint])
    moved = [frame @ of_joint for frame, of_joint in zip(frames, points[1:], strict=True) if of_joint.size]
    fixed = [jnp.broadcast_to(points[0], points[0].shape)] if points[0].size else []
    starts, ends = zip(*(jnp.split(part, 2, axis=1) for part in [*fixed, *moved]), strict=True)
    return jnp.concatenate([*starts, *ends], axis=1)


def _pair_constants(
    capsules: Capsules, pairs: np.ndarray, order: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """What turns the ends of capsules into the vectors u, v and w of the pairs; u.u, v.v and the sum of the radii."""
    count, column = len(order), np.argsort(order)
    selection = np.zeros((2 * count, 3 * len(pairs)), np.float32)
    for k, (i, j) in enumerate(pairs):
        a, c = column[i], column[j]
        for row, column_of, sign in (
            (count + a, k, 1), (a, k, -1), (count + c, len(pairs) + k, 1), (c, len(pairs) + k, -1),
            (a, 2 * len(pairs) + k, 1), (c, 2 * len(pairs) + k, -1),
        ):  # fmt: skip
            selection[row, column_of] += sign
    squared = np.sum((np.asarray(capsules.end) - np.asarray(capsules.start)) ** 2, axis=1)
    i, j = pairs.T
    values = squared[i], squared[j], capsules.radius[i] + capsules.radius[j]
    return selection, (values[0].astype(np.float32), values[1].astype(np.float32), values[2].astype(np.float32))


def _pair_distances(vectors: Array, constants: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Array:
    """Distances of pairs of capsules, as `mimic.retargeting.costs.segment_distance` computes those of their axes."""
    uu, vv, radii = constants
    u, v, w = jnp.split(vectors[:3], 3, axis=1)
    uv, uw, vw = (jnp.sum(x * y, axis=0) for x, y in ((u, v), (u, w), (v, w)))
    determinant = uu * vv - uv * uv
    is_parallel = determinant <= _PARALLEL * uu * vv
    s = jnp.where(is_parallel, 0.5, (uv * vw - vv * uw) / jnp.where(is_parallel, 1.0, determinant))
    per_u, per_v = 1 / np.maximum(uu, _TINY), 1 / np.maximum(vv, _TINY)
    s = jnp.minimum(jnp.maximum(s, 0.0), 1.0)
    t = jnp.minimum(jnp.maximum((uv * s + vw) * per_v, 0.0), 1.0)
    s = jnp.minimum(jnp.maximum((uv * t - uw) * per_u, 0.0), 1.0)
    t = jnp.minimum(jnp.maximum((uv * s + vw) * per_v, 0.0), 1.0)
    difference = w + s * u - t * v
    return jnp.sqrt(jnp.sum(difference * difference, axis=0)) - radii
