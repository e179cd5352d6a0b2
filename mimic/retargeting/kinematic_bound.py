"""Kinematic bound: the learner's joint states nearest to those of the expert, whatever the controller."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.arms.embodiment import Embodiment
from mimic.arms.pose_limits import pose_limits
from mimic.base.compilation import compiled_once
from mimic.metric.distance import Correspondence, Metric, Reduction, RotationMeasure, Weights
from mimic.metric.hand import NO_HAND, HandWeights
from mimic.metric.kinematics import LinkStates, link_states
from mimic.retargeting.pose import shared_joints
from mimic.retargeting.quasi_newton import Descent, bfgs

_POSES = 256  # random poses whose distances are compared to choose the initial guesses
MIN_SPEED = 1e-2  # rad/s, of the unit of the optimised velocities
# Shift of each round of exchange, in steps: each step tries the motions of the steps before and after it by this shift.
# Long shifts spread a minimum quickly, short ones track it.
_SHIFTS = (1, 2, 4, 1, 8, 1, 2, 1, 1, 1, 1, 1)
_HOP = 1.0  # standard deviation of a random step from the best motion [rad]; each round tries one
# Minimum numbers, over all times, of descents and of hops in a round: a short motion has fewer neighbours to exchange
# minima with, but is cheap.
_MIN_DESCENTS, _MIN_HOPS = 128, 32
_PERIOD = 32  # steps after which the random numbers repeat, which keeps the constants of a long motion small


class ClosestMotion(NamedTuple):
    """The learner's joint states nearest to those of the expert, and their distances.

    Attributes:
      qpos: [T, joints] angles [rad].
      qvel: [T, joints] velocities [rad/s].
      distance: [T] embodiment distance.
    """

    qpos: Float[Array, "time joints"]
    qvel: Float[Array, "time joints"]
    distance: Float[Array, " time"]


def kinematic_bound(
    expert: Embodiment,
    learner: Embodiment,
    qpos: Float[ArrayLike, "time expert_joints"],
    qvel: Float[ArrayLike, "time expert_joints"],
    correspondence: Correspondence,
    weights: Weights,
    *,
    rotation: RotationMeasure = "cosine",
    reduction: Reduction = "mean",
    hand_weights: HandWeights = NO_HAND,
    starts: int = 5,
    iterations: int = 20,
    seed: int = 0,
) -> Float[Array, " time"]:
    """Minimum distance found for each step, whatever the controller: the distance of `closest_motion`, same arguments.

    The result of a search, so an upper estimate of the true minimum: a controller can go below it where the search
    missed the minimum. `closest_motion` states how often that happens.
    """
    return closest_motion(
        expert,
        learner,
        qpos,
        qvel,
        correspondence,
        weights,
        rotation=rotation,
        reduction=reduction,
        hand_weights=hand_weights,
        starts=starts,
        iterations=iterations,
        seed=seed,
    ).distance


# Above 40 lines because of its docstring.
def closest_motion(
    expert: Embodiment,
    learner: Embodiment,
    qpos: Float[ArrayLike, "time expert_joints"],
    qvel: Float[ArrayLike, "time expert_joints"],
    correspondence: Correspondence,
    weights: Weights,
    *,
    rotation: RotationMeasure = "cosine",
    reduction: Reduction = "mean",
    hand_weights: HandWeights = NO_HAND,
    starts: int = 5,
    iterations: int = 20,
    seed: int = 0,
) -> ClosestMotion:
    """Minimises the embodiment distance over the learner's joint angles and velocities, independently at each step.

    The metric has local minima, so this is a search. It compares many random poses with the expert and takes the
    nearest of each subset as an initial guess, and one more: the expert's angles in the joints that both arms have by
    name. It optimises all of them. Then each of twelve rounds optimises, for each step, the best motion so far, those
    of an earlier and of a later step, and a random hop from it, and keeps the best. A minimum of one step is thus
    tracked in both directions. The optimiser is BFGS, see `bfgs`. It needs only a gradient of the metric, so any
    weights and correspondence can be used.

    The result is an upper estimate of the true minimum. The reference was the best of three searches, the longest from
    64 random poses. At none of 6600 steps, of ten pairs of arm and metric, was the error above 1e-3; at 21 it was above
    0.1 %, at most 3.3e-4 (`benchmarks.bound`, benchmarks/results/bound_cpu.json). Those steps are 0.1 s apart. In
    motions of four steps 1.5 s apart the error was above 1e-3 at 1 of 24 steps with hard correspondence, adaptive
    weights and "angle", and at none with the default metric.

    Angles stay within joint ranges of less than a full revolution. Velocities are unlimited, so no actuation is
    assumed.

    Args:
      expert: n joints.
      learner: its n_hat joints are optimised.
      qpos: [T, n] the expert's joint angles [rad], in order of time: neighbouring times exchange minima.
      qvel: [T, n] the expert's joint velocities [rad/s].
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.
      hand_weights: see `embodiment_distance`.
      starts: number of random initial guesses for each step; more, and more random hops, for T below 26, where steps
        have few neighbours.
      iterations: of the first descents; those of each round take half as many.
      seed: of the random poses and hops.

    Raises:
      ValueError: `qpos` or `qvel` is not [T, n] with T of at least 1, or `starts` or `iterations` is below 1.
    """
    qpos, qvel = jnp.asarray(qpos), jnp.asarray(qvel)
    if qpos.ndim != 2 or not len(qpos) or qpos.shape[1] != expert.num_joints or qvel.shape != qpos.shape:
        raise ValueError(
            f"qpos, qvel: expected shape [time, {expert.num_joints}] for {expert.name}, got {qpos.shape}, {qvel.shape}"
        )
    if starts < 1 or iterations < 1:
        raise ValueError(f"starts, iterations: expected at least 1, got {starts} and {iterations}")

    metric = Metric(correspondence, weights, rotation, reduction, hand_weights)
    return _motion_solver(expert, learner, metric, starts, iterations, seed)(qpos, qvel)


@compiled_once
def _motion_solver(
    expert: Embodiment, learner: Embodiment, metric: Metric, starts: int, iterations: int, seed: int
) -> Callable[[Array, Array], ClosestMotion]:
    """The function of the expert's motion that `closest_motion` compiles."""
    lower, upper = np.asarray(learner.joint_range).T

    def solve(qpos: Array, qvel: Array) -> ClosestMotion:
        states = jax.vmap(lambda *motion: link_states(expert, *motion))(qpos, qvel)
        speed = jnp.maximum(jnp.abs(qvel).max(axis=1), MIN_SPEED)
        limits = pose_limits(learner, speed.dtype)
        infinite = np.full_like(limits[1], np.inf)
        space = SearchSpace(
            lambda *motion: link_states(learner, *motion),
            (lower, upper),
            (np.concatenate([limits[0], -infinite]), np.concatenate([limits[1], infinite])),
        )
        guess = (shared_joints(expert, learner, values) for values in (qpos, qvel))
        return search_motion(metric, space, states, speed, *guess, starts=starts, iterations=iterations, seed=seed)

    return solve


class SearchSpace(NamedTuple):
    """The motions of a learner among which the nearest are searched. Its numbers may be traced.

    Attributes:
      link_states: function of its angles and velocities, each [joints].
      poses: minimum and maximum angles of random poses [rad], each [joints].
      limits: minimum and maximum of the angles, then of the velocities, each [2 joints]; may be infinite. A coordinate
        whose limits are equal stays there. `link_states` should not depend on it, or it disturbs the Hessians.
    """

    link_states: Callable[[Array, Array], LinkStates]
    poses: tuple[Any, Any]
    limits: tuple[Any, Any]


def search_motion(
    metric: Metric,
    space: SearchSpace,
    states: LinkStates,
    speed: Float[Array, " time"],
    qpos: Float[Array, "time joints"],
    qvel: Float[Array, "time joints"],
    *,
    starts: int,
    iterations: int,
    seed: int,
) -> ClosestMotion:
    """The search that `closest_motion` describes, for any function of link states. It does not compile by itself.

    Args:
      metric: between the expert and the learner.
      space: the learner's motions.
      states: link states of the expert, each [T, links, 3].
      speed: unit of the optimised velocities at each time [rad/s], at least `MIN_SPEED`.
      qpos: one of the initial guesses of the angles [rad].
      qvel: initial guess of the velocities [rad/s].
      starts: see `closest_motion`.
      iterations: see `closest_motion`.
      seed: see `closest_motion`.
    """
    times, rng = len(qpos), np.random.default_rng(seed)
    guesses = _initial_poses(metric, space, states, qpos, max(starts, _MIN_DESCENTS // times), rng)
    unit_qvel = jnp.broadcast_to((qvel / speed[:, None])[:, None], guesses.shape)
    points = jnp.concatenate([guesses, unit_qvel], axis=-1)
    descend = _descents(metric, space, states, speed)
    best = _search(descend, points, iterations, rng)
    best_qpos, best_qvel = jnp.split(best.point, 2, axis=-1)
    return ClosestMotion(best_qpos, speed[:, None] * best_qvel, best.value)


def _initial_poses(
    metric: Metric,
    space: SearchSpace,
    states: LinkStates,
    guess: Float[Array, "time joints"],
    starts: int,
    rng: np.random.Generator,
) -> Float[Array, "time guesses joints"]:
    """The guess, and the nearest of each of `starts` subsets of random poses; other subsets at each time."""
    count, (times, joints) = -(-_POSES // starts) * starts, guess.shape
    lower, upper = space.poses
    poses = jnp.asarray(lower + (upper - lower) * rng.random((count, joints)), guess.dtype)
    pose_states = jax.vmap(lambda pose: space.link_states(pose, jnp.zeros_like(pose)))(poses)
    pose_distances = jax.vmap(lambda state: jax.vmap(lambda pose: metric(state, pose))(pose_states))(states)
    orders = np.stack([rng.permutation(count) for _ in range(min(_PERIOD, times))]).reshape(-1, starts, count // starts)
    subsets = jnp.asarray(orders)[np.arange(times) % _PERIOD]
    distances = jnp.take_along_axis(pose_distances[:, None], subsets, axis=2)
    nearest = jnp.take_along_axis(subsets, jnp.argmin(distances, axis=2)[..., None], axis=2)[..., 0]
    return jnp.concatenate([guess[:, None], poses[nearest]], axis=1)


def _descents(
    metric: Metric, space: SearchSpace, states: LinkStates, speed: Float[Array, " time"]
) -> Callable[[Array, Array, int], Descent]:
    """A function of points [T, candidates, 2 joints] and their inverse Hessians: the best descent at each time.

    A point is the learner's angles, then its velocities in units of the expert's speed.
    """

    def descend(points: Array, inverses: Array, iterations: int) -> Descent:
        def at_time(state: LinkStates, speed: Array, points: Array, inverses: Array) -> Descent:
            def objective(point: Array) -> Array:
                qpos, unit_qvel = jnp.split(point, 2)
                return metric(state, space.link_states(qpos, speed * unit_qvel))

            descent = jax.vmap(lambda point, inverse: bfgs(objective, point, inverse, space.limits, iterations))
            descents = descent(points, inverses)
            return jax.tree.map(lambda x: x[jnp.argmin(descents.value)], descents)

        return jax.vmap(at_time)(states, speed, points, inverses)

    return descend


def _search(
    descend: Callable[[Array, Array, int], Descent],
    points: Float[Array, "time guesses coordinates"],
    iterations: int,
    rng: np.random.Generator,
) -> Descent:
    """Descents from all guesses, then rounds of exchange between times with random hops."""
    times, _, size = points.shape
    indices, count = np.arange(times), max(1, _MIN_HOPS // times)
    unknown = jnp.zeros((*points.shape, size), points.dtype)
    hops = _HOP * rng.normal(size=(len(_SHIFTS), min(_PERIOD, times), count, size // 2))
    hops = jnp.asarray(np.pad(hops, [(0, 0)] * 3 + [(0, size // 2)]), points.dtype)  # only angles hop

    def exchange(best: Descent, settings: tuple[Array, Array]) -> tuple[Descent, None]:
        shift, hop = settings
        neighbours = jnp.stack([jnp.clip(indices + sign * shift, 0, times - 1) for sign in (0, -1, 1)], axis=1)
        hopped = best.point[:, None] + hop[indices % _PERIOD]
        candidates = jnp.concatenate([best.point[neighbours], hopped], axis=1)
        # The curvature at a neighbour's minimum is nearly the same; starting from it saves most iterations.
        inverses = jnp.concatenate([best.inverse_hessian[neighbours], unknown[:, :1].repeat(count, axis=1)], axis=1)
        return descend(candidates, inverses, max(iterations // 2, 1)), None

    best = descend(points, unknown, iterations)
    return jax.lax.scan(exchange, best, (jnp.asarray(_SHIFTS), hops))[0]
