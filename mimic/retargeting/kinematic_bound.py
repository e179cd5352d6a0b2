"""The best that is known of an arm: the motion of the learner that is nearest to a pose and velocity of the expert."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.arms.embodiment import Embodiment
from mimic.metric.distance import Correspondence, Metric, Reduction, RotationMeasure, Weights
from mimic.metric.kinematics import LinkStates, link_states
from mimic.retargeting.pose import pose_limits, shared_joints
from mimic.retargeting.quasi_newton import Descent, bfgs

_POSES = 256  # random poses that are compared, without a descent, to find the initial guesses
_LEAST_SPEED = 1e-2  # rad/s, of the unit that the velocities are optimised in
# One round of exchange each: how many steps before and after it a time takes the motion of. The long ones spread a
# minimum quickly, the short ones track it.
_SHIFTS = (1, 2, 4, 1, 8, 1, 2, 1, 1, 1, 1, 1)
_HOP = 1.0  # standard deviation of a random step from the best motion [rad]; each round tries one
# Descents and hops a round, of all times together: few times have little to take from one another, but are cheap.
_LEAST_DESCENTS, _LEAST_HOPS = 128, 32
_VARIETY = 32  # after so many steps the random numbers recur, so that a long motion makes no large constants


class ClosestMotion(NamedTuple):
    """The learner's joint state that is nearest to the expert's, and how far it still is.

    Attributes:
      qpos: [T, joints] angles [rad].
      qvel: [T, joints] velocities [rad/s].
      distance: [T].
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
    starts: int = 5,
    iterations: int = 20,
    seed: int = 0,
) -> Float[Array, " time"]:
    """Least distance that is known at each step, whatever the controller: that of the `closest_motion`; same arguments.

    The best of a search, so an upper estimate of the true minimum: a controller can go below it where the search
    missed. How often that is: see `closest_motion`.
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
        starts=starts,
        iterations=iterations,
        seed=seed,
    ).distance


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
    starts: int = 5,
    iterations: int = 20,
    seed: int = 0,
) -> ClosestMotion:
    """Minimises the embodiment distance over the learner's joint angles and velocities, at each step by itself.

    The metric has local minima, so this searches. Many random poses are compared with the expert, and the nearest of
    each subset is an initial guess; one more is the expert's own angles in the joints that both arms have by name. All
    descend. Then each of twelve rounds refines the best motion of a step beside those of an earlier and a later step
    and a random hop from it, and keeps the best: a minimum that is found at one time is tracked in both directions.
    A descent is BFGS, see `bfgs`. It needs a gradient of the metric and nothing else, so any weights and correspondence
    will do.

    The result is the best of this search, an upper estimate of the true minimum. Against a reference of three searches,
    the longest of them from 64 random poses, at none of 6600 steps of ten pairs of arm and metric it was off by more
    than 1e-3, and at 21 by more than 0.1 %, at most 2.6e-4 (`benchmarks.bound`, benchmarks/results/bound_cpu.json).
    Those steps are 0.1 s apart: in motions of four steps 1.5 s apart it missed by more than 1e-3 at 1 of 24 steps with
    hard correspondence, adaptive weights and "angle", and at none with the default metric.

    Angles stay within the joint range where that is less than a full turn; velocities are free, so that no actuation
    is assumed.

    Args:
      expert: n joints.
      learner: its n_hat joints are optimised.
      qpos: [T, n] the expert's joint angles [rad]; successive times share what they find, so they should be in order.
      qvel: [T, n] the expert's joint velocities [rad/s].
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.
      starts: random initial guesses for each step, besides the expert's own angles; more of them, and more random
        hops, where T is below 26: then steps find little for one another.
      iterations: steps of the first descents; each round takes half as many.
      seed: of the random poses and hops.

    Raises:
      ValueError: `qpos` or `qvel` is not [T, n] with T of at least 1, or fewer than one start or iteration.
    """
    qpos, qvel = jnp.asarray(qpos), jnp.asarray(qvel)
    if qpos.ndim != 2 or not len(qpos) or qpos.shape[1] != expert.num_joints or qvel.shape != qpos.shape:
        raise ValueError(
            f"qpos, qvel: expected shape [time, {expert.num_joints}] for {expert.name}, got {qpos.shape}, {qvel.shape}"
        )
    if starts < 1 or iterations < 1:
        raise ValueError(f"starts, iterations: expected at least 1, got {starts} and {iterations}")

    metric = Metric(correspondence, weights, rotation, reduction)

    def solve(qpos: Array, qvel: Array) -> ClosestMotion:
        times, rng = len(qpos), np.random.default_rng(seed)
        states = jax.vmap(lambda *motion: link_states(expert, *motion))(qpos, qvel)
        speed = jnp.maximum(jnp.abs(qvel).max(axis=1), _LEAST_SPEED)
        own_qpos, own_qvel = (shared_joints(expert, learner, values) for values in (qpos, qvel))
        guesses = _initial_poses(metric, learner, states, own_qpos, max(starts, _LEAST_DESCENTS // times), rng)
        own_speed = jnp.broadcast_to((own_qvel / speed[:, None])[:, None], guesses.shape)
        points = jnp.concatenate([guesses, own_speed], axis=-1)
        descend = _descents(metric, learner, states, speed)
        found = _search(descend, points, iterations, rng)
        end_qpos, end_qvel = jnp.split(found.point, 2, axis=-1)
        return ClosestMotion(end_qpos, speed[:, None] * end_qvel, found.value)

    return jax.jit(solve)(qpos, qvel)


def _initial_poses(
    metric: Metric,
    learner: Embodiment,
    states: LinkStates,
    own: Float[Array, "time joints"],
    starts: int,
    rng: np.random.Generator,
) -> Float[Array, "time guesses joints"]:
    """The given angles, then the nearest of each of `starts` subsets of random poses; other subsets at each time."""
    count, times = -(-_POSES // starts) * starts, len(own)
    lower, upper = np.asarray(learner.joint_range).T
    poses = jnp.asarray(rng.uniform(lower, upper, (count, learner.num_joints)), own.dtype)
    pose_states = jax.vmap(lambda pose: link_states(learner, pose))(poses)
    tried = jax.vmap(lambda state: jax.vmap(lambda pose: metric(state, pose))(pose_states))(states)
    orders = np.stack([rng.permutation(count) for _ in range(min(_VARIETY, times))]).reshape(
        -1, starts, count // starts
    )
    subsets = jnp.asarray(orders)[np.arange(times) % _VARIETY]
    distances = jnp.take_along_axis(tried[:, None], subsets, axis=2)
    nearest = jnp.take_along_axis(subsets, jnp.argmin(distances, axis=2)[..., None], axis=2)[..., 0]
    return jnp.concatenate([own[:, None], poses[nearest]], axis=1)


def _descents(
    metric: Metric, learner: Embodiment, states: LinkStates, speed: Float[Array, " time"]
) -> Callable[[Array, Array, int], Descent]:
    """A function of [T, candidates, 2 joints] points and their inverse Hessians: each time's best end.

    A point is the learner's angles, then its velocities in units of the expert's speed.
    """
    lower, upper = pose_limits(learner, speed.dtype)
    infinite = np.full_like(upper, np.inf)
    limits = np.concatenate([lower, -infinite]), np.concatenate([upper, infinite])

    def descend(points: Array, inverses: Array, iterations: int) -> Descent:
        def at_time(state: LinkStates, speed: Array, points: Array, inverses: Array) -> Descent:
            def objective(point: Array) -> Array:
                qpos, unit_qvel = jnp.split(point, 2)
                return metric(state, link_states(learner, qpos, speed * unit_qvel))

            descent = jax.vmap(lambda point, inverse: bfgs(objective, point, inverse, limits, iterations))
            ends = descent(points, inverses)
            return jax.tree.map(lambda x: x[jnp.argmin(ends.value)], ends)

        return jax.vmap(at_time)(states, speed, points, inverses)

    return descend


def _search(
    descend: Callable[[Array, Array, int], Descent],
    points: Float[Array, "time guesses coordinates"],
    iterations: int,
    rng: np.random.Generator,
) -> Descent:
    """Descents from all guesses, then the rounds of exchange between times and of random hops."""
    times, _, size = points.shape
    present, count = np.arange(times), max(1, _LEAST_HOPS // times)
    unknown = jnp.zeros((*points.shape, size), points.dtype)
    hops = _HOP * rng.normal(size=(len(_SHIFTS), min(_VARIETY, times), count, size // 2))
    hops = jnp.asarray(np.pad(hops, [(0, 0)] * 3 + [(0, size // 2)]), points.dtype)  # angles alone hop

    def exchange(best: Descent, settings: tuple[Array, Array]) -> tuple[Descent, None]:
        shift, hop = settings
        taken = jnp.stack([jnp.clip(present + way * shift, 0, times - 1) for way in (0, -1, 1)], axis=1)
        hopped = best.point[:, None] + hop[present % _VARIETY]
        candidates = jnp.concatenate([best.point[taken], hopped], axis=1)
        # The curvature at a neighbour's minimum is nearly that of one's own: it saves most of the iterations.
        inverses = jnp.concatenate([best.inverse_hessian[taken], unknown[:, :1].repeat(count, axis=1)], axis=1)
        return descend(candidates, inverses, max(iterations // 2, 1)), None

    best = descend(points, unknown, iterations)
    return jax.lax.scan(exchange, best, (jnp.asarray(_SHIFTS), hops))[0]
