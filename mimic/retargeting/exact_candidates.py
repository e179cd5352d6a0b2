"""Postures of the learner at each time whose hand is where the expert's is, for many motions at once.

The branches of postures are searched at some times, the anchors, and tracked from each to its neighbours, forwards and
backwards, within the velocity limits. So each time has a set of candidates.

JAX computes chunks of a fixed number of times, so that motions of all lengths share its compiled functions. On a CPU
each thread computes a chunk; elsewhere the chunks of many motions are one batch.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.pose_limits import pose_limits
from mimic.base import compat
from mimic.base.compilation import UNOPTIMIZED, by_value, compiled_once, in_background
from mimic.retargeting.exact_chunks import CHUNK, in_chunks, in_threads
from mimic.retargeting.exact_pose import DESCENTS, FINE, ExactTargets, exact_solver
from mimic.retargeting.hand_target import Placement, is_exact
from mimic.retargeting.initial_guesses import RandomPoses
from mimic.retargeting.optimizers import newton
from mimic.retargeting.pose import shared_joints

SPACING, SEGMENTS = 16, CHUNK // 16  # times from one anchor to the next, and such segments in a chunk
INEXACT = 10.0  # distance that an exact hand is worth, at each time
PER_METRE = 1e3  # of the error of a hand that is not exact
_BRANCHES = 9  # at each anchor
_AT_ONCE = 64  # chunks of a batch at most
_STEPS, _DAMPING = 4, 1e-3  # Newton's method from the neighbouring time
_SLACK = 0.95  # of the maximum change for candidates, which are finished afterwards
_ANCHORS = np.arange(SEGMENTS + 1) * SPACING


class Candidates(NamedTuple):
    """Postures at each time.

    Attributes:
      qpos: [time, candidates, joints] [rad].
      cost: [time, candidates] distance, and more where the hand is not exact.
    """

    qpos: Float[Any, "time candidates joints"]
    cost: Float[Any, "time candidates"]


def candidates_of_motions(
    arms: tuple[Any, ...],
    motions: Sequence[Float[np.ndarray, "time joints"]],
    base: Placement,
    jump: Float[np.ndarray, " learner_joints"],
    random: RandomPoses,
) -> list[Candidates]:
    """The candidates of each motion.

    Args:
      arms: expert, learner, metric, costs and capsules.
      motions: of the expert [rad].
      base: of the learner.
      jump: maximum change of each joint from one time to the next [rad].
      random: poses of the learner, among which the searches begin.
    """
    chunks = [list(in_chunks(poses, CHUNK + 1, 1)) for poses in motions]
    every = np.stack([chunk for of_motion in chunks for chunk in of_motion])
    size = 1 if compat.is_cpu() else min(1 << (len(every) - 1).bit_length(), _AT_ONCE)
    candidates_of = _candidates(*arms)

    def computed(group: np.ndarray) -> Candidates:
        return jax.device_get(candidates_of(group, base, random, jump))

    groups = in_threads(computed, list(in_chunks(every, size)))
    of_chunks = Candidates(*(np.concatenate(part) for part in zip(*groups, strict=True)))
    ends = np.cumsum([len(of_motion) for of_motion in chunks])
    return [
        Candidates(*(x[end - len(own) : end].reshape(-1, *x.shape[2:])[: len(poses)] for x in of_chunks))
        for poses, own, end in zip(motions, chunks, ends, strict=True)
    ]


@by_value
def _candidates(*arms: Any) -> Callable[..., Candidates]:
    """The function from groups of CHUNK + 1 poses, a placement, random poses and the maximum change to candidates.

    Its two parts take about as long to compile, which they are at the same time at the first call.
    """
    branches, tracks = _branches(*arms), _tracks(*arms)
    began = []

    def group(poses: np.ndarray, base: Placement, random: RandomPoses, jump: np.ndarray) -> Candidates:
        if not began:
            guesses = np.zeros((len(poses), arms[1].num_joints, _BRANCHES, SEGMENTS + 1), np.float32)
            began.append(in_background(lambda: tracks(poses, guesses, base, jump)))
        found = branches(poses[:, _ANCHORS], base, random)
        began[0]()
        return tracks(poses, found, base, jump)

    return group


def _of_groups(function: Callable[..., Any], arrays: int) -> Callable[..., Any]:
    """A function of chunks, for groups of them as its first arrays; on a CPU groups of one."""
    if not compat.is_cpu():
        return lambda *arguments: jax.vmap(function, (*[0] * arrays, *[None] * (len(arguments) - arrays)))(*arguments)

    def of_one(*arguments: Any) -> Any:
        chunks = [chunk[0] for chunk in arguments[:arrays]]
        return jax.tree.map(lambda x: x[None], function(*chunks, *arguments[arrays:]))

    return of_one


@functools.partial(compiled_once, options=UNOPTIMIZED)
def _branches(*arms: Any) -> Callable[..., Array]:
    """The function from groups of poses at the anchors, a placement and random poses to postures on branches."""
    solver = exact_solver(*arms)

    def branches(poses: Array, base: Placement, random: RandomPoses) -> Array:
        first = shared_joints(solver.expert, solver.learner, poses)
        return solver.branches(solver.targets(base, poses)[0], first, random, DESCENTS._replace(kept=_BRANCHES))

    return _of_groups(branches, 1)


@compiled_once
def _tracks(*arms: Any) -> Callable[..., Candidates]:
    """The function from groups of CHUNK + 1 poses and postures at the anchors, a placement and the maximum change."""
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

    def chunk(poses: Array, branches: Array, base: Placement, jump: Array) -> Candidates:
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
        inexact = INEXACT + PER_METRE * position + rotation
        return Candidates(qpos.T, (cost + jnp.where(is_exact(position, rotation), 0, inexact)).T)

    return _of_groups(chunk, 2)


def at(tree: Any, index: Any) -> Any:
    """Arrays at some indices of their last axis."""
    return jax.tree.map(lambda x: x[..., index], tree)
