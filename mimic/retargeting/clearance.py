"""The clearance of an arm by few operations on matrices, see `mimic.control.clearance`.

`mimic.retargeting.costs` computes the same distances for optimisation, in scalar arithmetic: that is fast on GPUs, but
thousands of operations, which take milliseconds on a CPU.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.control import clearance as control_clearance
from mimic.control.clearance import ClearanceConstants
from mimic.metric.capsule_distances import colliding_pairs
from mimic.metric.matrix_kinematics import frame_constants, point_columns

_TINY = 1e-12  # m^2, replaces the squared length of a capsule that is a sphere
_PARALLEL = 1e-6  # of the squared sine of an angle: float32 resolves no smaller angle
_FAR = 1e3  # m: the height of an arm of which nothing moves


def make_clearance(
    arm: Embodiment, capsules: Capsules, floor_height: float = 0.0
) -> Callable[[Float[Array, " joints"]], Float[Array, ""]]:
    """Makes the function from joint angles [rad] to the clearance [m] of an arm, see `clearance_constants`."""
    constants = clearance_constants(arm, capsules, floor_height)

    def clearance(qpos: Float[Array, " joints"]) -> Float[Array, ""]:
        with jax.default_matmul_precision("highest"):  # TF32 would cost a millimetre
            return control_clearance.clearance(qpos, constants, jnp)

    return clearance


def clearance_constants(arm: Embodiment, capsules: Capsules, floor_height: float = 0.0) -> ClearanceConstants:
    """The constants of an arm's clearance.

    It is the minimum distance of the capsules' pairs that joints change, and of the capsules from the floor, except
    those on the base and on the joints at the base.

    Args:
      arm: the embodiment.
      capsules: from `fit_capsules`, of the same arm.
      floor_height: height of the floor in the base frame [m].
    """
    pairs = np.array(colliding_pairs(arm, capsules), int).reshape(-1, 2)
    moving = np.flatnonzero(~np.array(capsules.near_base))
    moved, fixed = _columns(arm, capsules, pairs, moving)
    squared = np.sum((np.asarray(capsules.end) - np.asarray(capsules.start)) ** 2, axis=1)
    radius, (i, j) = np.asarray(capsules.radius), pairs.T
    heights = np.tile(radius[moving] + floor_height, 2)
    if not len(pairs) and not len(moving):
        moved, fixed, heights = np.zeros((len(moved), 1)), np.zeros((3, 1)), np.full(1, -_FAR)
    inverses, product = 1 / np.maximum(squared, _TINY), squared[i] * squared[j]
    values = {
        "moved": moved,
        "fixed": fixed,
        "squared_v": squared[j],
        "per_u": inverses[i],
        "per_v": inverses[j],
        "product": product,
        "parallel": np.maximum(_PARALLEL * product, _TINY**2),
        "radii": radius[i] + radius[j],
        "heights": heights,
    }
    return ClearanceConstants(*frame_constants(arm), **{name: x.astype(np.float32) for name, x in values.items()})


def _columns(
    arm: Embodiment, capsules: Capsules, pairs: np.ndarray, moving: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`moved` and `fixed` of `ClearanceConstants`; the points are the ends of some capsules."""
    (start, fixed_start), (end, fixed_end) = (
        point_columns(arm, capsules.joint, np.c_[points, np.ones(len(points))])
        for points in (np.asarray(capsules.start), np.asarray(capsules.end))
    )
    i, j = pairs.T

    def columns(start: np.ndarray, end: np.ndarray) -> np.ndarray:
        u, v, w = end[:, i] - start[:, i], end[:, j] - start[:, j], start[:, i] - start[:, j]
        return np.concatenate([u, v, w, u, start[:, moving], end[:, moving]], axis=1)

    return columns(start, end), columns(fixed_start, fixed_end)
