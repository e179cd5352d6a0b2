"""Kinematic bound of any arm: its joint states nearest to those of the expert, whatever the controller."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.any_arm.arrays import ArmArrays
from mimic.any_arm.kinematics import link_states
from mimic.metric.distance import Metric
from mimic.metric.kinematics import LinkStates
from mimic.retargeting.kinematic_bound import MIN_SPEED, ClosestMotion, SearchSpace, search_motion

_FULL_TURN = 2 * np.pi - 1e-4  # rad: joints with this range or more are unlimited, as in `continuous_joints`


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
    compile by itself. Joints that do not move stay at their angle in `home`, with velocity 0.

    Args:
      arm: the learner.
      metric: between the expert and the learner, from `make_metric`.
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
    still = jnp.zeros_like(guess)
    speed = _speed_unit(expert_states)
    options = {"starts": starts, "iterations": iterations, "seed": seed}
    return search_motion(metric, _search_space(arm), expert_states, speed, guess, still, **options)


def _speed_unit(states: LinkStates) -> Float[Array, " time"]:
    """Unit of the joint velocities [rad/s]: the largest velocity of a link, angular or in chain lengths per second."""
    assert states.angular_velocity is not None
    largest = [jnp.abs(x).max(axis=(1, 2)) for x in (states.angular_velocity, states.linear_velocity)]
    return jnp.maximum(jnp.maximum(*largest), MIN_SPEED)


def _search_space(arm: ArmArrays) -> SearchSpace:
    """All motions of the joints that move; the others have limits of width 0."""
    free = arm.is_free > 0
    lower, upper = arm.joint_range[:, 0], arm.joint_range[:, 1]
    unlimited = upper - lower >= _FULL_TURN

    def limits(angle: Array, infinite: float) -> Array:
        angles = jnp.where(free, jnp.where(unlimited, infinite, angle), arm.home)
        return jnp.concatenate([angles, jnp.where(free, infinite, 0.0).astype(angles.dtype)])

    def states(qpos: Array, qvel: Array) -> LinkStates:
        # The gradient by a locked joint is 0, so that it does not enter the curvature of the others.
        return link_states(arm, jnp.where(free, qpos, arm.home), jnp.where(free, qvel, 0.0))

    poses = jnp.where(free, lower, arm.home), jnp.where(free, upper, arm.home)
    return SearchSpace(states, poses, (limits(lower, -jnp.inf), limits(upper, jnp.inf)))
