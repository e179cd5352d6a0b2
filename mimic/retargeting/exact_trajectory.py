"""Motions of the learner whose hand is where the expert's is, in one continuous path of least distance.

The branches of postures are searched at some times, the anchors, and tracked from each to its neighbours, forwards and
backwards, within the velocity limits. So each time has a set of candidates. Dynamic programming finds the path through
them that is exact as often as it can be, and then of least distance. Where this path changes branch faster than the
velocity limits allow, the arm follows it as fast as it may, with an exact hand if it is redundant. The postures of a
redundant arm are then smoothed over time, with the hand where it is. Where its hand is still not exact at some times,
although there are postures, ways past these times are searched among all postures of its self-motions.

JAX computes chunks of a fixed number of times, so that motions of all lengths share its compiled functions.
"""

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.link_match import hand_poses
from mimic.arms.pose_limits import continuous_joints, motion_limits, pose_limits
from mimic.base.compilation import UNOPTIMIZED, by_value, compiled_once, in_background
from mimic.metric.distance import Metric
from mimic.retargeting.costs import NO_COSTS, Costs
from mimic.retargeting.exact_chunks import CHUNK, by_chunks, hand_report, in_chunks
from mimic.retargeting.exact_pose import DESCENTS, FINE, ExactTargets, exact_solver
from mimic.retargeting.hand_target import (
    HandError,
    Placement,
    hand_cost_derivatives,
    is_exact,
    matched_hands,
    placed_hands,
)
from mimic.retargeting.initial_guesses import RandomPoses
from mimic.retargeting.optimizers import Derivatives, Scalars, Store, newton
from mimic.retargeting.path_smoothing import smoothed
from mimic.retargeting.pose import PoseImitation, shared_joints, wrap_angles
from mimic.retargeting.self_motions import past_failing_times

SPACING, SEGMENTS = 16, CHUNK // 16  # times from one anchor to the next, and such segments in a chunk
_BRANCHES = 9  # at each anchor
_THREADS = 8  # at most, each with a chunk
_STEPS, _DAMPING = 4, 1e-3  # Newton's method from the neighbouring time
_SLACK = 0.95  # of the maximum change for candidates, which are finished afterwards
_LEAP = 1.001  # of the maximum change: a path that changes by more passes to another branch
_INEXACT = 10.0  # distance that an exact hand is worth, at each time
_PER_METRE = 1e3  # of the error of a hand that is not exact
_PER_STEP = 1.0  # distance that a step on the way to another branch costs, of arms that stay exact meanwhile
_FRACTIONS = 1.0, 0.5, 0.0  # of the way to the path in a step
_POSITION_FIRST = 1e-3  # weight of the rotation of a hand that is not exact


class Candidates(NamedTuple):
    """Postures at each time.

    Attributes:
      qpos: [time, candidates, joints] [rad].
      cost: [time, candidates] distance, and more where the hand is not exact.
    """

    qpos: Float[Any, "time candidates joints"]
    cost: Float[Any, "time candidates"]


class _Path(NamedTuple):
    """Angles [rad], distances and errors of the hand [m, rad] of a path, and when it is exact within the limits."""

    qpos: np.ndarray
    distance: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    exact: np.ndarray

    def order(self) -> tuple[int, float]:
        """Greater for a better path."""
        return int(self.exact.sum()), -float(self.distance.mean())


def exact_trajectory(
    expert: Embodiment,
    learner: Embodiment,
    metric: Metric,
    poses: Float[np.ndarray, "time joints"],
    base: Placement,
    jump: Float[np.ndarray, " learner_joints"],
    random: RandomPoses,
    costs: Costs = NO_COSTS,
    capsules: Capsules | None = None,
) -> PoseImitation:
    """The motion; see `imitate_trajectory`."""
    arms, times = (expert, learner, metric, costs, capsules), len(poses)
    candidates_of = _candidates(*arms)
    first, *others = in_chunks(poses, CHUNK + 1, 1)
    chunks = [candidates_of(first, base, random, jump)]  # which compiles
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _THREADS)) as pool:
        chunks += pool.map(lambda x: jax.block_until_ready(candidates_of(x, base, random, jump)), others)
    candidates = Candidates(*(np.concatenate(jax.device_get(part))[:times] for part in zip(*chunks, strict=True)))
    continuous, ranges = continuous_joints(learner), np.asarray(learner.joint_range)
    report = hand_report(*arms)

    # Whether a redundant arm stays exact on the way to another branch is only known when it goes there.
    is_redundant = learner.num_joints > 6 * len(learner.hand_joint)
    lower, upper = motion_limits(learner)

    def judged(qpos: np.ndarray) -> _Path:
        """The path, smoothed where the arm is redundant."""
        qpos = smoothed(arms, poses, qpos, base, jump) if is_redundant else qpos
        distance, position, rotation = by_chunks(lambda x, qpos: report(x, base, qpos), poses, qpos)
        inside = np.all((qpos >= lower - 1e-6) & (qpos <= upper + 1e-6), axis=-1)
        return _Path(qpos, distance, position, rotation, is_exact(position, rotation) & inside)

    paths: list[_Path] = []
    for cost_of_step in (_PER_STEP, _INEXACT) if is_redundant else (_INEXACT,):
        qpos = within_ranges(best_path(candidates, jump, continuous, cost_of_step), ranges)
        if np.any(np.abs(np.diff(qpos, axis=0)) > jump):  # followed as fast as it can be
            qpos = _followed(arms, poses, qpos, base, jump)
        paths.append(judged(qpos))
        if paths[-1].exact.all():  # and, with the lower cost, of the lower distance
            break
    best = max(paths, key=_Path.order)
    if is_redundant and not best.exact.all():
        chosen, possible = matched_hands(expert, learner), candidates.cost < _INEXACT
        hands = placed_hands(base, hand_poses(expert, poses)[:, chosen[:, 0]])
        starts = candidates.qpos[0][possible[0]]
        other = past_failing_times(
            learner, chosen[:, 1], hands, best.qpos, best.exact, jump, possible.any(axis=1), starts
        )
        best = max(best, judged(other), key=_Path.order)
    qpos, distance, position, rotation, exact = map(jnp.asarray, best)
    return PoseImitation(qpos, distance, exact, HandError(position, rotation, exact))


_ANCHORS = np.arange(SEGMENTS + 1) * SPACING


@by_value
def _candidates(*arms: Any) -> Callable[..., Candidates]:
    """The function from CHUNK + 1 poses, a placement, random poses and the maximum change to CHUNK candidates.

    Its two parts take about as long to compile, which they are at the same time at the first call.
    """
    branches, tracks = _branches(*arms), _tracks(*arms)
    began = []

    def chunk(poses: np.ndarray, base: Placement, random: RandomPoses, jump: np.ndarray) -> Candidates:
        if not began:
            guesses = np.zeros((arms[1].num_joints, _BRANCHES, SEGMENTS + 1), np.float32)
            began.append(in_background(lambda: tracks(poses, base, guesses, jump)))
        found = branches(poses[_ANCHORS], base, random)
        began[0]()
        return tracks(poses, base, found, jump)

    return chunk


@functools.partial(compiled_once, options=UNOPTIMIZED)
def _branches(*arms: Any) -> Callable[..., Array]:
    """The function from poses at the anchors, a placement and random poses to postures on different branches."""
    solver = exact_solver(*arms)

    def branches(poses: Array, base: Placement, random: RandomPoses) -> Array:
        first = shared_joints(solver.expert, solver.learner, poses)
        return solver.branches(solver.targets(base, poses)[0], first, random, DESCENTS._replace(kept=_BRANCHES))

    return branches


@compiled_once
def _tracks(*arms: Any) -> Callable[..., Candidates]:
    """The function from CHUNK + 1 poses, a placement, postures at the anchors and the maximum change to candidates."""
    solver = exact_solver(*arms)
    lower, upper = (x[:, None, None] for x in pose_limits(solver.learner, np.float32))
    steps = np.arange(1, SPACING + 1)[:, None]
    times = np.concatenate([_ANCHORS[:-1] + steps, _ANCHORS[1:] - steps], axis=1)

    def track(targets: ExactTargets, begin: Array, jump: Array) -> Array:
        """[SPACING, joints, lanes, 2 SEGMENTS] candidates from those at the anchors."""

        def step(qpos: Array, now: Array) -> tuple[Array, Array]:
            box = jnp.maximum(lower, qpos - jump), jnp.minimum(upper, qpos + jump)
            of_time = functools.partial(solver.derivatives(at(targets, now)), smoothing=FINE)
            qpos = newton(of_time, qpos, box, _STEPS, _DAMPING).qpos
            return qpos, qpos

        return jax.lax.scan(step, begin, jnp.asarray(times))[1]

    def chunk(poses: Array, base: Placement, branches: Array, jump: Array) -> Candidates:
        targets, states = solver.targets(base, poses)
        begin = jnp.concatenate([branches[..., :-1], branches[..., 1:]], axis=-1)
        tracks = track(targets, begin, (_SLACK * jump).astype(poses.dtype)[:, None, None])
        forwards = jnp.concatenate([begin[None, ..., :SEGMENTS], tracks[:-1, ..., :SEGMENTS]])
        both = jnp.concatenate([forwards, tracks[::-1, ..., SEGMENTS:]], axis=2)
        qpos = jnp.moveaxis(both, 0, -1).reshape(*both.shape[1:3], -1)  # [joints, candidates, times]
        inner = np.arange(CHUNK)
        qpos = solver.finished(at(targets, inner), qpos)
        position, rotation = solver.errors(at(targets, inner), qpos)
        cost = solver.distances(at(states, inner), qpos) + solver.costs_of(poses[:-1], qpos)
        inexact = _INEXACT + _PER_METRE * position + rotation
        return Candidates(qpos.T, (cost + jnp.where(is_exact(position, rotation), 0, inexact)).T)

    return chunk


def at(tree: Any, index: Any) -> Any:
    """Arrays at some indices of their last axis."""
    return jax.tree.map(lambda x: x[..., index], tree)


def best_path(
    candidates: Candidates, jump: np.ndarray, continuous: np.ndarray, cost_of_step: float
) -> Float[np.ndarray, "time joints"]:
    """The candidates with the minimum sum of costs, and of steps on the way to others, by dynamic programming.

    Args:
      candidates: at each time.
      jump: maximum change of each joint from one time to the next [rad].
      continuous: joints whose full revolutions do not count.
      cost_of_step: for each time by which a change takes longer than the next time.
    """
    qpos, cost = candidates
    total, before = cost[0], []
    for previous, now, own in zip(qpos[:-1], qpos[1:], cost[1:], strict=True):
        apart = np.abs(wrap_angles(now - previous[:, None], continuous))
        through = total[:, None] + cost_of_step * np.maximum(np.ceil((apart / jump).max(axis=-1)) - 1, 0)
        before.append(through.argmin(axis=0))
        total = own + through.min(axis=0)
    index = [int(total.argmin())]
    for row in reversed(before):
        index.append(int(row[index[-1]]))
    path = qpos[np.arange(len(qpos)), index[::-1]]
    change = wrap_angles(np.diff(path, axis=0), continuous)
    return np.concatenate([path[:1], path[0] + np.cumsum(change, axis=0)])


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
    follow, last, chunks = _follower(*arms), path[0].astype(np.float32), []
    for of_expert, of_path in zip(in_chunks(poses, CHUNK), in_chunks(path, CHUNK), strict=True):
        chunks.append(np.asarray(follow(of_expert, base, of_path, last, jump)))
        last = chunks[-1][-1]
    return np.concatenate(chunks)[: len(path)]


@compiled_once
def _follower(*arms: Any) -> Callable[..., Array]:
    """The function from CHUNK poses, a placement, a path, the angles before it and the maximum change to angles.

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

            def derivatives(qpos: Scalars, store: Store) -> Derivatives:
                return hand_cost_derivatives(solver.learner, solver.pairs[:, 1], target.hands, qpos, weight, store)

            goal = jnp.clip(goal, last - jump, last + jump)
            starts = last[:, None] + (goal - last)[:, None] * np.array(_FRACTIONS, last.dtype)
            lanes = newton(derivatives, starts, box, _STEPS, _DAMPING).qpos
            position, rotation = solver.errors(target, lanes[..., None])
            order = jnp.where(is_exact(position, rotation), 0, 1 + _PER_METRE * position + rotation)
            qpos = lanes[:, jnp.argmin(order)]
            qpos = qpos if is_redundant else jnp.where(leaps, goal, qpos)
            return qpos, qpos

        of_times = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0)[..., None], targets)
        return jax.lax.scan(follow, last, (of_times, path, exact))[1]

    return chunk
