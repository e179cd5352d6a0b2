"""Smaller changes of posture from time to time, with the hand where it is."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from mimic.arms.pose_limits import motion_limits, pose_limits
from mimic.base.compat import stored
from mimic.base.compilation import compiled_once
from mimic.retargeting.exact_chunks import by_chunks
from mimic.retargeting.exact_pose import exact_solver
from mimic.retargeting.hand_target import Placement, hand_cost_derivatives, is_exact
from mimic.retargeting.optimizers import Derivatives, Scalars, newton

_ROUNDS, _WINDOW = 6, 10.0  # and times over which postures are smoothed
_ON_TARGET = 1e4  # weight of the hand's cost, of that of changes
_STEPS, _DAMPING = 5, 1e-5  # Newton's method back to the exact hand, with the least change of posture
_ROUNDING = 1e-6  # rad, of single precision


def smoothed(
    arms: tuple[Any, ...],
    poses: Float[np.ndarray, "time joints"],
    path: Float[np.ndarray, "time learner_joints"],
    base: Placement,
    jump: Float[np.ndarray, " learner_joints"],
) -> Float[np.ndarray, "time learner_joints"]:
    """A path of a redundant arm with smaller changes, and no hand that is exact no more.

    Each round solves a linear least-squares problem over all times and returns to the exact hand. Times at which that
    fails, and those whose hand is not exact, keep their posture.

    Args:
      arms: expert, learner, metric, costs and capsules.
      poses: of the expert [rad].
      path: of the learner [rad].
      base: of the learner.
      jump: maximum change of each joint from one time to the next [rad].
    """
    if len(path) < 3:
        return path
    back, (lower, upper) = _back_to_the_hand(*arms), motion_limits(arms[1])

    def returned(qpos: np.ndarray) -> tuple[np.ndarray, Bool[np.ndarray, " time"], np.ndarray]:
        """Angles with an exact hand near some, whether it is and was exact within the limits, and its stiffness."""
        near, was, now, stiffness = by_chunks(lambda x, qpos: back(x, base, qpos), poses, qpos)
        inside = [np.all((x >= lower - _ROUNDING) & (x <= upper + _ROUNDING), axis=-1) for x in (qpos, near)]
        return near, np.stack([was & inside[0], now & inside[1]]), stiffness

    def fastest(qpos: np.ndarray) -> float:
        return float(np.abs(np.diff(qpos, axis=0) / jump).max(initial=0))

    _, (movable, _), stiffness = returned(path)
    best, now, bound = path, path, max(1.0, fastest(path))
    for _ in range(_ROUNDS):
        near = np.clip(least_change(now, path, stiffness, movable, jump), lower, upper)
        new, (_, good), stiffness = returned(near)
        movable = movable & good
        now = np.where(movable[:, None], new, now)
        best = now if fastest(now) <= bound else best
    return best


def least_change(
    path: np.ndarray, original: np.ndarray, stiffness: np.ndarray, movable: np.ndarray, jump: np.ndarray
) -> np.ndarray:
    """The path near the original one with least changes, and the hand near where it is, by one banded system.

    It minimises the sum over times of |q' - q''|^2 from one time to the next, |q' - q_original|^2 / window^2, and the
    weight times d^T H d, with d = q' - q and the Hessian H of the hand's cost; |.| is in units of `jump`.
    """
    from scipy.linalg import solveh_banded  # half a second to import

    times, joints = path.shape
    weight = np.square(jump.mean() / jump)
    stay = np.where(movable, _WINDOW**-2, _ON_TARGET)[:, None]
    neighbours = np.full((times, 1), 2.0)
    neighbours[[0, -1]] = 1.0
    values, vectors = np.linalg.eigh(np.asarray(stiffness, float))  # of single precision, so that some are below 0
    held = vectors * np.maximum(values, 0)[:, None] @ np.swapaxes(vectors, 1, 2)
    blocks = _ON_TARGET * held + np.eye(joints) * (weight * (stay + neighbours))[..., None]
    band = np.zeros((joints + 1, times * joints))
    for below in range(joints):
        rows = np.arange(joints - below)
        band[below].reshape(times, joints)[:, rows] = blocks[:, rows + below, rows]
    band[joints, : (times - 1) * joints] = -np.tile(weight, times - 1)
    change = np.pad(np.diff(path, axis=0), ((1, 1), (0, 0)))
    force = weight * (stay * (np.where(movable[:, None], original, path) - path) + np.diff(change, axis=0))
    return path + solveh_banded(band, force.ravel(), lower=True).reshape(times, joints)


@compiled_once
def _back_to_the_hand(*arms: Any) -> Callable[..., tuple[Array, ...]]:
    """The function from poses, a placement and angles to angles with an exact hand.

    It also returns whether the hand was exact and is, and its stiffness.
    """
    solver = exact_solver(*arms)
    limits = pose_limits(solver.learner, np.float32)

    def back(poses: Array, base: Placement, qpos: Array) -> tuple[Array, ...]:
        targets, _ = solver.targets(base, poses)

        def derivatives(qpos: Scalars) -> Derivatives:
            return hand_cost_derivatives(solver.learner, solver.pairs[:, 1], targets.hands, qpos, 1.0)

        begin = qpos.astype(poses.dtype).T
        lanes = newton(derivatives, begin, limits, _STEPS, _DAMPING).qpos
        was, now = (is_exact(*(x[0] for x in solver.errors(targets, qpos[:, None]))) for qpos in (begin, lanes))
        lower, joints = stored(derivatives([*lanes])).hessian, range(len(lanes))
        rows = [[lower[max(i, j)][min(i, j)] + jnp.zeros_like(lanes[0]) for j in joints] for i in joints]
        return lanes.T, was, now, jnp.moveaxis(jnp.stack([jnp.stack(row) for row in rows]), -1, 0)

    return back
