"""Postures of the learner at each time whose hand is where the expert's is, for many motions at once.

The branches of postures are searched at some times, the anchors, and tracked from each to its neighbours, forwards and
backwards, within the velocity limits. So each time has a set of candidates.

The motions follow each other, each filled up to whole segments from one anchor to the next. JAX computes chunks of a
fixed number of these times, so that motions of all lengths share its compiled functions.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.pose_limits import pose_limits
from mimic.base.compilation import UNOPTIMIZED, by_value, compiled_once, in_background
from mimic.retargeting.exact_chunks import chunk_size, in_chunks, in_threads
from mimic.retargeting.exact_pose import DESCENTS, FINE, ExactTargets, exact_solver
from mimic.retargeting.hand_target import Placement, is_exact
from mimic.retargeting.initial_guesses import RandomPoses
from mimic.retargeting.optimizers import newton
from mimic.retargeting.pose import shared_joints

SPACING = 16  # times from one anchor to the next
INEXACT = 10.0  # distance that an exact hand is worth, at each time
PER_METRE = 1e3  # of the error of a hand that is not exact
_BRANCHES = 9  # at each anchor
_STEPS, _DAMPING = 4, 1e-3  # Newton's method from the neighbouring time
_SLACK = 0.95  # of the maximum change for candidates, which are finished afterwards


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
    padded = [np.pad(poses, ((0, SPACING + -len(poses) % SPACING), (0, 0)), mode="edge") for poses in motions]
    candidates_of = _candidates(*arms)

    def computed(poses: np.ndarray) -> Candidates:
        return jax.device_get(candidates_of(poses, base, random, jump))

    chunks = in_threads(computed, list(in_chunks(np.concatenate(padded), chunk_size() + 1, 1)))
    every = Candidates(*(np.concatenate(part) for part in zip(*chunks, strict=True)))
    starts = np.cumsum([0, *map(len, padded[:-1])])
    return [
        Candidates(*(x[start : start + len(poses)] for x in every))
        for poses, start in zip(motions, starts, strict=True)
    ]


@by_value
def _candidates(*arms: Any) -> Callable[..., Candidates]:
    """The function from a chunk and one pose more, a placement, random poses and the maximum change to candidates.

    Its two parts take about as long to compile, which they are at the same time at the first call.
    """
    branches, tracks = _branches(*arms), _tracks(*arms)
    began = []

    def chunk(poses: np.ndarray, base: Placement, random: RandomPoses, jump: np.ndarray) -> Candidates:
        anchors = poses[::SPACING]
        if not began:
            guesses = np.zeros((arms[1].num_joints, _BRANCHES, len(anchors)), np.float32)
            began.append(in_background(lambda: tracks(poses, guesses, base, jump)))
        found = branches(anchors, base, random)
        began[0]()
        return tracks(poses, found, base, jump)

    return chunk


@functools.partial(compiled_once, options=UNOPTIMIZED)
def _branches(*arms: Any) -> Callable[..., Array]:
    """The function from poses at the anchors, a placement and random poses to postures on branches."""
    solver = exact_solver(*arms)

    def branches(poses: Array, base: Placement, random: RandomPoses) -> Array:
        first = shared_joints(solver.expert, solver.learner, poses)
        return solver.branches(solver.targets(base, poses)[0], first, random, DESCENTS._replace(kept=_BRANCHES))

    return branches


@compiled_once
def _tracks(*arms: Any) -> Callable[..., Candidates]:
    """The function from a chunk and one pose more, postures at the anchors, a placement and the maximum change."""
    solver = exact_solver(*arms)
    lower, upper = (x[:, None, None] for x in pose_limits(solver.learner, np.float32))

    def track(targets: ExactTargets, begin: Array, times: np.ndarray, jump: Array) -> Array:
        """[SPACING, joints, lanes, starts] candidates from those at the anchors, at times [SPACING, starts]."""

        def step(qpos: Array, now: Array) -> tuple[Array, Array]:
            box = jnp.maximum(lower, qpos - jump), jnp.minimum(upper, qpos + jump)
            of_time = functools.partial(solver.derivatives(at(targets, now)), smoothing=FINE)
            qpos = newton(of_time, qpos, box, _STEPS, _DAMPING).qpos
            return qpos, qpos

        return jax.lax.scan(step, begin, jnp.asarray(times))[1]

    def chunk(poses: Array, branches: Array, base: Placement, jump: Array) -> Candidates:
        targets, states = solver.targets(base, poses)
        anchors, steps = np.arange(0, len(poses), SPACING), np.arange(1, SPACING + 1)[:, None]
        times, segments = np.concatenate([anchors[:-1] + steps, anchors[1:] - steps], axis=1), len(anchors) - 1
        begin = jnp.concatenate([branches[..., :-1], branches[..., 1:]], axis=-1)
        tracks = track(targets, begin, times, (_SLACK * jump).astype(poses.dtype)[:, None, None])
        forwards = jnp.concatenate([begin[None, ..., :segments], tracks[:-1, ..., :segments]])
        both = jnp.concatenate([forwards, tracks[::-1, ..., segments:]], axis=2)
        qpos = jnp.moveaxis(both, 0, -1).reshape(*both.shape[1:3], -1)  # [joints, candidates, times]
        inner = np.arange(len(poses) - 1)
        qpos = solver.finished(at(targets, inner), qpos)
        position, rotation = solver.errors(at(targets, inner), qpos)
        cost = solver.distances(at(states, inner), qpos) + solver.costs_of(poses[:-1], qpos)
        inexact = INEXACT + PER_METRE * position + rotation
        return Candidates(qpos.T, (cost + jnp.where(is_exact(position, rotation), 0, inexact)).T)

    return chunk


def at(tree: Any, index: Any) -> Any:
    """Arrays at some indices of their last axis."""
    return jax.tree.map(lambda x: x[..., index], tree)
