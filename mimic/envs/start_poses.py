"""Where the learner starts its episodes, at rest."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import pose_limits
from mimic.base.compilation import UNOPTIMIZED, compiled_once, on_host, value_key
from mimic.control import clearance
from mimic.metric.capsule_distances import clearance_constants, colliding_pairs
from mimic.retargeting.costs import Costs
from mimic.retargeting.exact_chunks import by_chunks
from mimic.retargeting.pose import imitate_pose

_AT_HOME = 1e-4  # rad
# Weight of the distance from the home pose, so that redundant joints start alike where many poses are equally near. It
# adds 0.1 % to the mean distance of a Panda from a captured arm.
_HOME = 0.01
_SELF_COLLISION, CLEARANCE = 10.0, 0.05  # weight, and m
# Poses at a time, so that one function is compiled for any number of demonstrations; random initial guesses. With 12
# guesses the poses are 0.4 % farther, and others from one window to the next.
_WITHOUT, _WITH_CAPSULES = (256, 48), (64, 12)


def start_poses(
    expert: Embodiment,
    learner: Embodiment,
    qpos: Float[np.ndarray, "demonstrations expert_joints"],
    metric: dict[str, Any],
    capsules: Capsules | None = None,
) -> Float[np.ndarray, "demonstrations joints"]:
    """The learner's home pose where the expert starts in its own, else the pose nearest to the expert's [rad].

    Args:
      expert: n joints.
      learner: n_hat joints.
      qpos: first poses of the demonstrations [rad].
      metric: correspondence, weights, rotation and reduction of the embodiment distance.
      capsules: of the learner, to start without self-collision; None to ignore it.
    """
    poses = np.tile(np.asarray(learner.home, np.float32), (len(qpos), 1))
    elsewhere = ~np.isclose(qpos, np.asarray(expert.home), rtol=0, atol=_AT_HOME).all(axis=1)
    if value_key(expert) == value_key(learner):
        poses[elsewhere] = np.clip(qpos[elsewhere], *pose_limits(learner, np.float32))  # measured angles may be outside
    elif elsewhere.any():
        poses[elsewhere] = _nearest_poses(expert, learner, metric, qpos[elsewhere])
    if capsules is not None:
        constants = clearance_constants(learner, capsules, pairs=colliding_pairs(learner, capsules))
        for from_there in (True, False):  # where that fails with random guesses, which take six times as long
            distances = clearance.pair_distances(*clearance.capsule_axes(poses, constants), constants)
            near = elsewhere & (distances < 0.8 * CLEARANCE).any(axis=1)
            if near.any():
                warm_start = poses[near] if from_there else None
                poses[near] = _nearest_poses(expert, learner, metric, qpos[near], capsules, warm_start)
    return poses


def _nearest_poses(
    expert: Embodiment,
    learner: Embodiment,
    metric: dict[str, Any],
    qpos: Float[np.ndarray, "poses expert_joints"],
    capsules: Capsules | None = None,
    warm_start: Float[np.ndarray, "poses joints"] | None = None,
) -> Float[np.ndarray, "poses joints"]:
    """The poses nearest to the expert's, see `imitate_pose`."""
    size, _ = _WITH_CAPSULES if capsules else _WITHOUT
    rows = [np.asarray(x, np.float32) for x in (qpos, warm_start) if x is not None]
    with on_host():  # compiles several times faster, and runs once
        solve = _pose_solver(expert, learner, metric, capsules)
        (nearest,) = by_chunks(lambda *rows: (solve(*rows),), *rows, size=size)
    return nearest


@functools.partial(compiled_once, options=UNOPTIMIZED)
def _pose_solver(
    expert: Embodiment, learner: Embodiment, metric: dict[str, Any], capsules: Capsules | None
) -> Callable[..., Array]:
    """The function of the expert's poses, and of initial guesses if any, that `_nearest_poses` compiles."""
    _, starts = _WITH_CAPSULES if capsules else _WITHOUT
    costs = Costs(home=_HOME, self_collision=_SELF_COLLISION if capsules else 0.0, clearance=CLEARANCE)
    settings: dict[str, Any] = {"starts": starts, "costs": costs, "capsules": capsules, **metric}

    def solve(poses: Array, warm_start: Array | None = None) -> Array:
        return imitate_pose(expert, learner, poses, warm_start=warm_start, **settings).qpos

    return solve
