"""Kinematic bound of any arm: its joint states nearest to those of the expert, whatever the controller."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS, ArmArrays
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.kinematics import LinkStates, link_states
from mimic.retargeting.array_nearest import solve_free
from mimic.retargeting.kinematic_bound import MIN_SPEED, ClosestMotion, SearchSpace, search_motion

_PARTS = ("linear_velocity", "angular_velocity")
_REFINEMENTS = 6  # reweighted steps of the velocities; with 4, 12 and 30 the bounds are the same to 1e-6
_MIN_DIFFERENCE = 1e-3  # of velocities, in units of the expert's; the weight in a step is not above the inverse of it
_DAMPING = 1e-4  # of the normal equations, relative to the mean of their diagonal


def closest_motion(
    arm: ArmArrays,
    metric: Metric,
    expert_states: LinkStates,
    guess: Float[Array, "time joints"],
    *,
    starts: int = 5,
    iterations: int = 20,
    seed: int = 0,
) -> ClosestMotion:
    """The search of `mimic.closest_motion` for one arm and one demonstration, all of which may be traced.

    Batch with `jax.vmap`, or with `jax.lax.map` over the arms, and compile once for all arms: the search does not
    compile by itself. Joints that do not move stay at their angle in `home`, with velocity 0. The descents start from
    velocity 0 and end up to 2e-4 above the minimum, so the velocities are refined at the angles found.

    Args:
      arm: the learner.
      metric: between the expert and the learner, with constant weights, from `make_metric`.
      expert_states: link states of the expert in order of time, each [T, links, 3].
      guess: angles from which one of the descents starts, such as the expert's in the joints of the same name [rad].
      starts: number of random initial guesses for each step, see `mimic.closest_motion`.
      iterations: of the first descents; those of each round of exchange take half as many.
      seed: of the random poses and hops, which are the same for all arms.

    Raises:
      ValueError: `guess` is not [T, joints], or `starts` or `iterations` is below 1.
    """
    expected = (len(expert_states.position), len(arm.home))
    if guess.shape != expected:
        raise ValueError(f"guess: expected shape {expected} (time, joints), got {guess.shape}")
    if starts < 1 or iterations < 1:
        raise ValueError(f"starts, iterations: expected at least 1, got {starts} and {iterations}")
    speed, options = _speed_unit(expert_states), {"starts": starts, "iterations": iterations, "seed": seed}
    space, still = _search_space(arm), jnp.zeros_like(guess)
    closest = search_motion(metric, space, expert_states, speed, guess, still, **options)
    return jax.vmap(lambda *at_time: _refined(arm, metric, space, *at_time))(expert_states, speed, closest)


def _refined(
    arm: ArmArrays,
    metric: Metric,
    space: SearchSpace,
    expert: LinkStates,
    speed: Float[Array, ""],
    start: ClosestMotion,
) -> ClosestMotion:
    """The joint state at one time with velocities nearer to the minimum, or the same one.

    The metric is convex in the velocities, a sum of weighted norms of linear functions: iteratively reweighted least
    squares, as in `pose_quadratic`. In contrast to a descent, it is not slow at the kinks where velocities match.
    """
    assert isinstance(metric.weights, DistanceWeights) and not callable(metric.correspondence)
    shares = jnp.asarray(metric.correspondence)
    weights = [getattr(metric.weights, part) for part in _PARTS]
    # Link velocities are linear in the joints' velocities: those of unit velocities are their Jacobian.
    jacobian = jax.vmap(lambda unit: space.link_states(start.qpos, unit))(jnp.eye(MAX_JOINTS, dtype=speed.dtype))
    columns, targets = ([getattr(x, part) for part in _PARTS] for x in (jacobian, expert))

    def refine(qvel: Array, _: None) -> tuple[Array, None]:
        matrix, vector = jnp.zeros((MAX_JOINTS, MAX_JOINTS), speed.dtype), jnp.zeros_like(qvel)
        for weight, column, target in zip(weights, columns, targets, strict=True):
            difference = jnp.sum(qvel[:, None, None] * column, axis=0) - target[:, None]
            length = jnp.sqrt(jnp.sum(difference**2, axis=-1))
            stiffness = weight * shares / jnp.maximum(length / speed, _MIN_DIFFERENCE)
            weighted = column * stiffness.sum(axis=0)[:, None]
            matrix += jnp.sum(weighted[:, None] * column, axis=(2, 3))
            vector += jnp.sum(column * jnp.sum(stiffness[..., None] * target[:, None], axis=0), axis=(1, 2))
        mean = jnp.trace(matrix) / jnp.maximum(arm.is_free.sum(), 1)
        regular = matrix + jnp.diag(_DAMPING * mean + 1e-6 + (1 - arm.is_free))
        step = solve_free(regular, vector - jnp.sum(matrix * qvel, axis=1), arm.is_free)
        return qvel + step, None

    qvel, _ = jax.lax.scan(refine, start.qvel, None, length=_REFINEMENTS)
    distance = metric(expert, space.link_states(start.qpos, qvel))
    refined = ClosestMotion(start.qpos, qvel, distance)
    return jax.tree.map(lambda new, old: jnp.where(distance < start.distance, new, old), refined, start)


def _speed_unit(states: LinkStates) -> Float[Array, " time"]:
    """Unit of the joint velocities [rad/s]: the largest velocity of a link, angular or in chain lengths per second."""
    assert states.angular_velocity is not None
    largest = [jnp.abs(x).max(axis=(1, 2)) for x in (states.angular_velocity, states.linear_velocity)]
    return jnp.maximum(jnp.maximum(*largest), MIN_SPEED)


def _search_space(arm: ArmArrays) -> SearchSpace:
    """All motions of the joints that move; the others have limits of width 0."""
    free = arm.is_free > 0

    def pinned(angles: Array) -> Array:
        return jnp.where(free, angles, arm.home)

    def states(qpos: Array, qvel: Array) -> LinkStates:
        # The gradient by a locked joint is 0, so that it does not enter the curvature of the others.
        return link_states(arm, pinned(qpos), jnp.where(free, qvel, 0.0))

    unlimited = jnp.where(free, jnp.full_like(arm.home, jnp.inf), 0.0)
    lower, upper = arm.angle_limits
    limits = jnp.concatenate([lower, -unlimited]), jnp.concatenate([upper, unlimited])
    return SearchSpace(states, (pinned(arm.joint_range[:, 0]), pinned(arm.joint_range[:, 1])), limits)
