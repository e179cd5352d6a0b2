"""Motions of the learner whose hand is where the expert's is, in one continuous path of least distance.

Dynamic programming finds the path through the candidates of `exact_candidates` that is exact as often as it can be, and
then of least distance. Where this path changes branch faster than the velocity limits allow, the arm follows it as fast
as it may, with an exact hand if it is redundant. The postures of a redundant arm are then smoothed over time, with the
hand where it is. Where its hand is still not exact at some times, although there are postures, ways past these times
are searched among all postures of its self-motions.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.link_match import hand_poses
from mimic.arms.pose_limits import continuous_joints, motion_limits, pose_limits
from mimic.base.compilation import compiled_once, on_host
from mimic.metric.distance import Metric
from mimic.retargeting.costs import NO_COSTS, Costs
from mimic.retargeting.exact_candidates import INEXACT, PER_METRE, Candidates, candidates_of_motions
from mimic.retargeting.exact_chunks import by_chunks, hand_report, in_chunks, in_threads
from mimic.retargeting.exact_pose import ExactTargets, exact_solver
from mimic.retargeting.hand_target import (
    Placement,
    hand_cost_derivatives,
    is_exact,
    matched_hands,
    placed_hands,
)
from mimic.retargeting.initial_guesses import RandomPoses
from mimic.retargeting.optimizers import Derivatives, Scalars, newton
from mimic.retargeting.path_smoothing import smoothed
from mimic.retargeting.pose import wrap_angles
from mimic.retargeting.self_motions import past_failing_times

_TIMES = (
    256  # of a call of what goes from time to time, on the host: elsewhere a step takes longer to start than to run
)
_STEPS, _DAMPING = 4, 1e-3  # Newton's method from the last time
_LEAP = 1.001  # of the maximum change: a path that changes by more passes to another branch
_PER_STEP = 1.0  # distance that a step on the way to another branch costs, of arms that stay exact meanwhile
_FRACTIONS = 1.0, 0.5, 0.0  # of the way to the path in a step
_POSITION_FIRST = 1e-3  # weight of the rotation of a hand that is not exact


class ExactPath(NamedTuple):
    """Angles [rad], distances and errors of the hand [m, rad] of a path, and when it is exact within the limits."""

    qpos: np.ndarray
    distance: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    exact: np.ndarray

    def order(self) -> tuple[int, float]:
        """Greater for a better path."""
        return int(self.exact.sum()), -float(self.distance.mean())


def exact_trajectories(
    expert: Embodiment,
    learner: Embodiment,
    metric: Metric,
    motions: Sequence[Float[np.ndarray, "time joints"]],
    base: Placement,
    jump: Float[np.ndarray, " learner_joints"],
    random: RandomPoses,
    costs: Costs = NO_COSTS,
    capsules: Capsules | None = None,
) -> Iterator[ExactPath]:
    """The motion for each of the expert; see `imitate_trajectory`.

    Raises:
      ValueError: costs of motion.
    """
    if costs.of_motion:
        raise ValueError("costs: expected no costs of motion for exact hands")
    arms = expert, learner, metric, costs, capsules
    candidates = candidates_of_motions(arms, motions, base, jump, random)

    def motion(poses: np.ndarray, candidates: Candidates) -> ExactPath:
        return _motion(arms, poses, base, jump, candidates)

    yield from in_threads(motion, motions, candidates)


def _motion(
    arms: tuple[Any, ...], poses: np.ndarray, base: Placement, jump: np.ndarray, candidates: Candidates
) -> ExactPath:
    """The motion through candidates; see the head of this file."""
    expert, learner, *_ = arms
    continuous, ranges = continuous_joints(learner), np.asarray(learner.joint_range)
    report = hand_report(*arms)

    # Whether a redundant arm stays exact on the way to another branch is only known when it goes there.
    is_redundant = learner.num_joints > 6 * len(learner.hand_joint)
    lower, upper = motion_limits(learner)

    def judged(qpos: np.ndarray) -> ExactPath:
        """The path, smoothed where the arm is redundant."""
        qpos = smoothed(arms, poses, qpos, base, jump) if is_redundant else qpos
        distance, position, rotation = by_chunks(lambda x, qpos: report(x, base, qpos), poses, qpos)
        inside = np.all((qpos >= lower - 1e-6) & (qpos <= upper + 1e-6), axis=-1)
        return ExactPath(qpos, distance, position, rotation, is_exact(position, rotation) & inside)

    paths: list[ExactPath] = []
    for cost_of_step in (_PER_STEP, INEXACT) if is_redundant else (INEXACT,):
        qpos = within_ranges(best_path(candidates, jump, continuous, cost_of_step), ranges)
        if np.any(np.abs(np.diff(qpos, axis=0)) > jump):  # followed as fast as it can be
            qpos = _followed(arms, poses, qpos, base, jump)
        paths.append(judged(qpos))
        if paths[-1].exact.all():  # and, with the lower cost, of the lower distance
            break
    best = max(paths, key=ExactPath.order)
    if is_redundant and not best.exact.all():
        chosen, possible = matched_hands(expert, learner), candidates.cost < INEXACT
        hands = placed_hands(base, hand_poses(expert, poses)[:, chosen[:, 0]])
        starts = candidates.qpos[0][possible[0]]
        other = past_failing_times(
            learner, chosen[:, 1], hands, best.qpos, best.exact, jump, possible.any(axis=1), starts
        )
        best = max(best, judged(other), key=ExactPath.order)
    return best


def best_path(
    candidates: Candidates, jump: Float[np.ndarray, " joints"], continuous: np.ndarray, cost_of_step: float
) -> Float[np.ndarray, "time joints"]:
    """The candidates with the minimum sum of costs, and of steps on the way to others, by dynamic programming.

    Args:
      candidates: at each time.
      jump: maximum change of each joint from one time to the next [rad].
      continuous: joints whose full revolutions do not count.
      cost_of_step: for each time by which a change takes longer than the next time.
    """
    totals, before = [candidates.cost[:1]], []
    with on_host():
        advance = _advance(continuous)
        for qpos, cost in zip(*(in_chunks(part, _TIMES + 1, 1) for part in candidates), strict=True):
            results = advance(totals[-1][-1], qpos, cost[1:], jump, cost_of_step)
            for part, result in zip((totals, before), results, strict=True):
                part.append(np.asarray(result))
    last = len(candidates.cost) - 1
    index, through = [int(np.concatenate(totals)[last].argmin())], np.concatenate(before)
    for time in reversed(range(last)):
        index.append(int(through[time, index[-1]]))
    path = candidates.qpos[np.arange(last + 1), index[::-1]]
    change = wrap_angles(np.diff(path, axis=0), continuous)
    return np.concatenate([path[:1], path[0] + np.cumsum(change, axis=0)])


@compiled_once
def _advance(continuous: np.ndarray) -> Callable[..., tuple[Array, Array]]:
    """The function that `best_path` calls for the times of a chunk, one after the other.

    It is from the sums of costs at a time, the candidates there and later, costs later, the maximum change and the cost
    of a step to the sums at the later times, and the candidates before these.
    """

    def advance(total: Array, qpos: Array, cost: Array, jump: Array, cost_of_step: Array) -> tuple[Array, Array]:
        def step(total: Array, now: tuple[Array, Array, Array]) -> tuple[Array, tuple[Array, Array]]:
            before, qpos, cost = now
            apart = jnp.abs(wrap_angles(qpos[:, None] - before, continuous))  # [to, from]
            late = jnp.maximum(jnp.ceil((apart / jump).max(axis=-1)) - 1, 0)
            through = total + cost_of_step * late
            total = cost + through.min(axis=1)
            return total, (total, through.argmin(axis=1))

        return jax.lax.scan(step, total, (qpos[:-1], qpos[1:], cost))[1]

    return advance


def within_ranges(
    path: Float[np.ndarray, "time joints"], ranges: Float[np.ndarray, "joints 2"]
) -> Float[np.ndarray, "time joints"]:
    """The path, with joints of more than a full revolution shifted by full revolutions to the middle of their range."""
    middle = (path.min(axis=0) + path.max(axis=0)) / 2
    revolutions = np.round((middle - ranges.mean(axis=1)) / (2 * np.pi))
    return path - 2 * np.pi * np.where(np.ptp(ranges, axis=1) >= 2 * np.pi - 1e-4, revolutions, 0)


def _followed(
    arms: tuple[Any, ...], poses: np.ndarray, path: np.ndarray, base: Placement, jump: np.ndarray
) -> np.ndarray:
    """A path as fast as the maximum change allows."""
    last, chunks = path[0].astype(np.float32), []
    with on_host():
        follow = _follower(*arms)
        for of_expert, of_path in zip(in_chunks(poses, _TIMES), in_chunks(path, _TIMES), strict=True):
            chunks.append(np.asarray(follow(of_expert, base, of_path, last, jump)))
            last = chunks[-1][-1]
    return np.concatenate(chunks)[: len(path)]


@compiled_once
def _follower(*arms: Any) -> Callable[..., Array]:
    """The function from poses, a placement, a path, the angles before it and the maximum change to angles.

    Each time is solved from three fractions of the way to the path; of those with an exact hand the farthest is taken.
    An arm that is not redundant has none of these on its way to another branch and goes straight.
    """
    solver = exact_solver(*arms)
    lower, upper = pose_limits(solver.learner, np.float32)
    is_redundant = solver.learner.num_joints > 6 * len(solver.pairs)

    def chunk(poses: Array, base: Placement, path: Array, last: Array, jump: Array) -> Array:
        targets, _ = solver.targets(base, poses)
        path, jump = path.astype(poses.dtype), (jump * (1 - 1e-5)).astype(poses.dtype)
        exact = is_exact(*solver.errors(targets, path.T))

        def follow(last: Array, now: tuple[ExactTargets, Array, Array]) -> tuple[Array, Array]:
            target, goal, exact = now
            box = jnp.maximum(lower, last - jump)[:, None], jnp.minimum(upper, last + jump)[:, None]
            leaps = jnp.any(jnp.abs(goal - last) > _LEAP * jump)
            weight = jnp.where(exact, 1, _POSITION_FIRST).astype(last.dtype)

            def derivatives(qpos: Scalars) -> Derivatives:
                return hand_cost_derivatives(solver.learner, solver.pairs[:, 1], target.hands, qpos, weight)

            goal = jnp.clip(goal, last - jump, last + jump)
            starts = last[:, None] + (goal - last)[:, None] * np.array(_FRACTIONS, last.dtype)
            lanes = newton(derivatives, starts, box, _STEPS, _DAMPING).qpos
            position, rotation = solver.errors(target, lanes[..., None])
            order = jnp.where(is_exact(position, rotation), 0, 1 + PER_METRE * position + rotation)
            qpos = lanes[:, jnp.argmin(order)]
            qpos = qpos if is_redundant else jnp.where(leaps, goal, qpos)
            return qpos, qpos

        of_times = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0)[..., None], targets)
        return jax.lax.scan(follow, last, (of_times, path, exact))[1]

    return chunk
