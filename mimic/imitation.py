"""The best that an arm can do: the motion of the learner that is nearest to a pose and velocity of the expert."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.distance import Correspondence, Reduction, RotationMeasure, Weights, embodiment_distance
from mimic.embodiment import Embodiment
from mimic.kinematics import LinkStates, link_states
from mimic.pose import pose_limits, shared_joints

_POSES = 256  # random poses that are tried, without a descent, to find the starts
_SEARCH_STEP, _POLISH_STEP = 0.1, 0.03  # first step of a descent [rad, and times the expert's speed]
_LEAST_SPEED = 1e-2  # rad/s
_FAST, _SLOW = 0.9, 0.99  # decay of the running means of gradient and squared gradient


_Motion = tuple[Array, Array]  # angles and velocities


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
    starts: int = 4,
    iterations: int = 40,
    seed: int = 0,
) -> Float[Array, " time"]:
    """What no controller can go below at each step: the distance of the `closest_motion`; same arguments."""
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
    starts: int = 4,
    iterations: int = 40,
    seed: int = 0,
) -> ClosestMotion:
    """Minimises the embodiment distance over the learner's joint angles and velocities, at each step by itself.

    The metric has local minima, so this searches. Many random poses are compared with the expert, and the nearest of
    each share of them starts a descent; one more starts at the expert's own angles in the joints that both arms have by
    name. Then the best end and those of the neighbouring times are refined: what is found at one time is found at all.
    A descent is Adam with a step that shrinks along a cosine. It needs no more of the metric than a gradient, so any
    weights and correspondence will do, and it copes with the kinks that norms have at a match. The best point that was
    seen is returned, with its true distance.

    Angles stay within the joint range where that is less than a full turn; velocities are free, so that this is a bound
    for any actuation.

    Args:
      expert: n joints.
      learner: its n_hat joints are optimised.
      qpos: [T, n] the expert's joint angles [rad].
      qvel: [T, n] the expert's joint velocities [rad/s].
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`.
      rotation: see `embodiment_distance`.
      reduction: see `embodiment_distance`.
      starts: descents for each step, besides the one from the expert's own angles.
      iterations: gradient steps of a descent; the refinement takes twice as many.
      seed: of the random poses.

    Raises:
      ValueError: `qpos` or `qvel` is not [T, n], or fewer than one start or iteration.
    """
    qpos, qvel = jnp.asarray(qpos), jnp.asarray(qvel)
    if qpos.ndim != 2 or qpos.shape[1] != expert.num_joints or qvel.shape != qpos.shape:
        raise ValueError(
            f"qpos, qvel: expected shape [time, {expert.num_joints}] for {expert.name}, got {qpos.shape}, {qvel.shape}"
        )
    if starts < 1 or iterations < 1:
        raise ValueError(f"starts, iterations: expected at least 1, got {starts} and {iterations}")

    def distance(states: LinkStates, learner_states: LinkStates) -> Array:
        return embodiment_distance(
            states, learner_states, correspondence, weights, rotation=rotation, reduction=reduction
        )

    def descend(states: LinkStates, starts: _Motion, speed: Array, count: int, step: float) -> ClosestMotion:
        objective = lambda motion: distance(states, link_states(learner, motion[0], speed * motion[1]))  # noqa: E731
        descent = jax.vmap(lambda *start: _descend(objective, start, learner, count, step))
        ends = descent(starts[0], starts[1] / speed)
        end_qpos, end_qvel, end_distance = jax.tree.map(lambda x: x[jnp.argmin(ends.distance)], ends)
        return ClosestMotion(end_qpos, speed * end_qvel, end_distance)

    def solve(qpos: Array, qvel: Array) -> ClosestMotion:
        states = jax.vmap(lambda *motion: link_states(expert, *motion))(qpos, qvel)
        speed = jnp.maximum(jnp.abs(qvel).max(axis=1), _LEAST_SPEED)  # a descent's unit of velocity
        first = jax.vmap(_starts(distance, expert, learner, starts, seed))(states, qpos, qvel)
        search = functools.partial(descend, count=iterations, step=_SEARCH_STEP)
        refine = functools.partial(descend, count=2 * iterations, step=_POLISH_STEP)
        found = jax.vmap(search)(states, first, speed)
        return jax.vmap(refine)(states, (_with_neighbours(found.qpos), _with_neighbours(found.qvel)), speed)

    return jax.jit(solve)(qpos, qvel)


def _starts(
    distance: Callable[[LinkStates, LinkStates], Array], expert: Embodiment, learner: Embodiment, starts: int, seed: int
) -> Callable[[LinkStates, Array, Array], _Motion]:
    """A function of the expert's states and motion that gives [starts + 1, joints] angles and velocities."""

    def choose(states: LinkStates, expert_qpos: Array, expert_qvel: Array) -> _Motion:
        poses = _random_poses(learner, -(-_POSES // starts) * starts, seed, expert_qpos.dtype)
        pose_states = jax.vmap(lambda pose: link_states(learner, pose))(poses)
        tried = jax.vmap(lambda pose: distance(states, pose))(pose_states).reshape(starts, -1)
        chosen = poses.reshape(starts, -1, learner.num_joints)[jnp.arange(starts), jnp.argmin(tried, axis=1)]
        own_qpos, own_qvel = (shared_joints(expert, learner, values) for values in (expert_qpos, expert_qvel))
        start_qpos = jnp.concatenate([own_qpos[None], chosen])
        return start_qpos, jnp.broadcast_to(own_qvel, start_qpos.shape)

    return choose


def _with_neighbours(values: Float[Array, "time joints"]) -> Float[Array, "time 3 joints"]:
    """Each time's values, with those before and after it."""
    before, after = jnp.concatenate([values[:1], values[:-1]]), jnp.concatenate([values[1:], values[-1:]])
    return jnp.stack([values, before, after], axis=1)


def _descend(
    distance: Callable[[_Motion], Array],
    start: _Motion,
    learner: Embodiment,
    iterations: int,
    first_step: float,
) -> ClosestMotion:
    """Adam with a step that shrinks to zero along a cosine, keeping the best point."""
    lower, upper = pose_limits(learner, start[0].dtype)

    def iterate(carry: Any, count: Array) -> tuple[Any, None]:
        motion, mean, square, best = carry
        value, gradient = jax.value_and_grad(distance)(motion)
        better = value < best.distance
        best = jax.tree.map(
            lambda new, old: jnp.where(better, new, old), ClosestMotion(motion[0], motion[1], value), best
        )
        mean = jax.tree.map(lambda m, g: _FAST * m + (1 - _FAST) * g, mean, gradient)
        square = jax.tree.map(lambda s, g: _SLOW * s + (1 - _SLOW) * g * g, square, gradient)
        size = 0.5 * first_step * (1 + jnp.cos(jnp.pi * count / iterations))
        bias = jnp.sqrt(1 - _SLOW ** (count + 1)) / (1 - _FAST ** (count + 1))
        qpos, qvel = jax.tree.map(
            lambda x, m, s: x - size * bias * m / (jnp.sqrt(s) + jnp.finfo(s.dtype).tiny ** 0.25), motion, mean, square
        )
        return ((jnp.clip(qpos, lower, upper), qvel), mean, square, best), None

    zero = jax.tree.map(jnp.zeros_like, start)
    start = jnp.clip(start[0], lower, upper), start[1]
    best = ClosestMotion(*start, jnp.asarray(jnp.inf, start[0].dtype))
    counts = jnp.arange(iterations, dtype=start[0].dtype)
    return jax.lax.scan(iterate, (start, zero, zero, best), counts)[0][3]


def _random_poses(arm: Embodiment, count: int, seed: int, dtype: Any) -> Float[Array, "count joints"]:
    lower, upper = np.asarray(arm.joint_range).T
    return jnp.asarray(np.random.default_rng(seed).uniform(lower, upper, (count, arm.num_joints)), dtype)
