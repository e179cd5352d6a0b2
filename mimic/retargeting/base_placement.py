"""Where the base of an arm stands so that its hand reaches what the expert's reaches."""

from collections.abc import Sequence

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from mimic.arms.embodiment import Embodiment
from mimic.arms.link_match import hand_poses
from mimic.arms.pose_limits import continuous_joints
from mimic.metric.distance import NO_HAND, Correspondence, HandWeights, Metric, Reduction, RotationMeasure, Weights
from mimic.retargeting.hand_speeds import speeds_needed
from mimic.retargeting.hand_target import POSITION_TOLERANCE, Placement, placement
from mimic.retargeting.pose import checked_poses, imitate_pose
from mimic.retargeting.trajectory import checked_jump, imitate_trajectory

_FRAMES, _BASES, _ROUNDS = 36, 64, 3  # frames that judge a base, bases in each round of the search, and rounds
_SPREAD = np.array([0.5, 0.5, 0.2, np.pi])  # of the first round: chain lengths of the expert, and rad
_NARROWER = 0.35  # factor of the spread from one round to the next
_SEARCHES = 5  # at most
_FAST = 0.1  # of the poses: the fastest, from which a third of the frames are chosen
_BEST = 4  # bases that the next round starts from, and that are checked on a whole motion at the end
# Of the score: room in the joint ranges and below the velocity limits, embodiment distance, and hands whose position
# alone is exact, or that are too fast; an exact hand has 1.
_ROOM, _DISTANCE, POSITION_ALONE = 0.2, 0.3, 0.3


def find_base(
    expert: Embodiment,
    learner: Embodiment,
    motions: Sequence[Float[ArrayLike, "time joints"]],
    correspondence: Correspondence,
    weights: Weights,
    *,
    rotation: RotationMeasure = "cosine",
    reduction: Reduction = "mean",
    hand_weights: HandWeights = NO_HAND,
    largest_jump: Float[ArrayLike, " learner_joints"] | float = 0.3,
    seed: int = 0,
) -> Float[np.ndarray, "4"]:
    """The base [x, y, z, yaw] of the learner from which most hands are exact, with room in the joints' limits.

    A random search that narrows in three rounds judges bases by frames of all motions, a third of them among the
    fastest, and by the speeds that these need of the joints. Of the best bases the first is taken from which the whole
    longest motion is exact, within `largest_jump`. Where it is from none, the search goes on with frames that were not
    exact among those that judge, and at last the base is taken from which most are.

    Args:
      expert: n joints.
      learner: n_hat joints.
      motions: of the expert, [T, n] each [rad].
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.
      hand_weights: see `embodiment_distance`.
      largest_jump: see `imitate_trajectory`.
      seed: of the search.

    Returns:
      The base in the expert's base frame [m, rad], as `imitate_pose` and `imitate_trajectory` take it.

    Raises:
      ValueError: no motion, or what `imitate_trajectory` rejects.
    """
    if not len(motions):
        raise ValueError("motions: expected at least one, got none")
    paths = [np.asarray(checked_poses(expert, motion, "motions", axes=("time",)), np.float32) for motion in motions]
    paths = sorted(paths, key=len, reverse=True)
    poses, longest = np.concatenate(paths), paths[0]
    steps = np.concatenate([np.diff(path, axis=0, append=path[-1:]) for path in paths])
    jump = checked_jump(learner, largest_jump)
    metric = Metric(correspondence, weights, rotation, reduction, hand_weights)
    places, part = _places(expert, poses), _FRAMES // 3
    speed = np.linalg.norm(_places(expert, poses + steps) - places, axis=1)
    fast = _spread(places, np.flatnonzero(speed >= np.quantile(speed, 1 - _FAST)), part)
    judged = np.concatenate([_spread(places, np.arange(len(poses)), _FRAMES - part), fast])
    start, best = np.zeros((1, 4)), (-1.0, np.zeros(4))
    for search in range(_SEARCHES):
        frames = poses[judged], steps[judged]
        bases = best_bases(expert, learner, *frames, metric, jump=jump, seed=seed + search, start=start)
        for base in bases:
            motion = imitate_trajectory(
                expert, learner, longest, hand="exact", largest_jump=largest_jump, base=base, **metric.arguments
            )
            assert motion.hand is not None
            exact = np.asarray(motion.hand.exact)
            if exact.mean() > best[0]:
                best, failing = (float(exact.mean()), base), np.flatnonzero(~exact)
            if exact.all():
                return base
        start = best[1][None]
        judged = np.concatenate([judged[:part], fast, _spread(places, failing, part)])
    return best[1]


def _places(arm: Embodiment, qpos: Float[np.ndarray, "poses joints"]) -> Float[np.ndarray, "poses numbers"]:
    """Positions and axes of the hands, of which a metre counts as 1.4 radians."""
    hands = hand_poses(arm, qpos)[..., :3, :]
    return (hands / [2, 2, 2, 1]).reshape(len(qpos), -1)


def _spread(places: np.ndarray, among: Int[np.ndarray, " chosen"], count: int) -> Int[np.ndarray, " count"]:
    """Those of some poses whose hands are farthest from each other, so that none is far from one of them.

    Each next pose is the one with the greatest distance of its hand from those before.
    """
    places = places[among]
    chosen, nearest = [0], np.full(len(places), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.linalg.norm(places - places[chosen[-1]], axis=1))
        chosen.append(int(nearest.argmax()))
    return among[chosen]


def best_bases(
    expert: Embodiment,
    learner: Embodiment,
    frames: Float[np.ndarray, "frames joints"],
    steps: Float[np.ndarray, "frames joints"],
    metric: Metric,
    *,
    jump: Float[np.ndarray, " learner_joints"],
    seed: int = 0,
    start: Float[np.ndarray, "bases 4"] = np.zeros((1, 4)),  # noqa: B008
) -> Float[np.ndarray, "bases 4"]:
    """The best bases near some that are found for single poses of the expert [rad], the best first; see `find_base`.

    Args:
      expert, learner: the arms.
      frames: poses of the expert [rad].
      steps: its changes from these to the next times [rad], zero where no speed is asked for.
      metric: see `find_base`.
      jump: maximum change of the learner's joints in this time [rad].
      seed: of the search.
      start: bases near which it begins.
    """
    generator, spread = np.random.default_rng(seed), _SPREAD * np.array([*[float(expert.chain_length)] * 3, 1.0])
    bases, scores = start, np.full(len(start), -np.inf)
    for _ in range(_ROUNDS):
        new = bases[np.arange(_BASES) % len(bases)] + generator.uniform(-spread, spread, (_BASES, 4))
        new[0] = bases[0]
        new[:, 3] -= 2 * np.pi * np.round(new[:, 3] / (2 * np.pi))  # within half a turn
        of_new = _scores(expert, learner, frames, steps, new, metric, jump)
        bases, scores = np.concatenate([bases, new]), np.concatenate([scores, of_new])
        order = np.argsort(-scores, kind="stable")[:_BEST]
        bases, scores, spread = bases[order], scores[order], spread * _NARROWER
    return bases


def repeated(bases: Float[np.ndarray, "bases 4"], count: int) -> Placement:
    """Placements of bases, each for a number of poses that follow each other."""
    placements = [placement(base) for base in bases]
    return Placement(*(np.repeat(np.stack(part, axis=-1), count, axis=-1) for part in zip(*placements, strict=True)))


def _scores(
    expert: Embodiment,
    learner: Embodiment,
    frames: Float[np.ndarray, "frames joints"],
    steps: Float[np.ndarray, "frames joints"],
    bases: Float[np.ndarray, "bases 4"],
    metric: Metric,
    jump: Float[np.ndarray, " learner_joints"],
) -> Float[np.ndarray, " bases"]:
    """Scores of bases: the mean over the frames of exact hands, room, and distance, or of positions."""
    poses, count = np.tile(frames, (len(bases), 1)), len(bases)
    steps = np.tile(steps, (count, 1))
    stacked = repeated(bases, len(frames))
    solution = jax.device_get(imitate_pose(expert, learner, poses, hand="exact", base=stacked, **metric.arguments))
    lower, upper = np.asarray(learner.joint_range).T
    room = 2 * np.minimum(solution.qpos - lower, upper - solution.qpos) / (upper - lower)
    speed = speeds_needed(expert, learner, poses, steps, np.asarray(solution.qpos), stacked, jump)
    room = np.minimum(np.where(continuous_joints(learner), 1, room).min(axis=-1), 1 - speed)
    score = np.where(solution.hand.position <= POSITION_TOLERANCE, POSITION_ALONE, 0)
    score = np.where(solution.hand.exact & (speed <= 1), 1 + _ROOM * room - _DISTANCE * solution.distance, score)
    return score.reshape(count, -1).mean(axis=-1)
