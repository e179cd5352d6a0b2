"""Torques of any arm that bring its joints to target angles at the end of a control step, within its limits."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.any_arm.arrays import MAX_JOINTS, ArmArrays
from mimic.any_arm.dynamics import inertia_matrix, torque_of_arm
from mimic.any_arm.nearest import solve_free
from mimic.arms.arm import SPEED_FACTOR

# Weight of the velocity at the end of a step against the angle there, in units of the step. Without it the velocity
# would alternate from step to step; 0.05 to 1 give optimality gaps of 0.14 to 0.17 % on panda4dof.
_VELOCITY_WEIGHT = 0.15
# The deceleration that is counted on, as a fraction of the velocity limit that is lost in a control step.
_BRAKING = 0.3


class Targets(NamedTuple):
    """Where the joints should be at the end of a control step.

    Attributes:
      qpos: [joints] angles [rad]; they may be too far away for one step.
      qvel: [joints] velocities there [rad/s].
    """

    qpos: Float[Array, " joints"]
    qvel: Float[Array, " joints"]


def effective_inertia(arm: ArmArrays, qpos: Float[Array, " joints"]) -> Float[Array, " joints"]:
    """Effective inertia of each joint while the others are free, 1 / (M^-1)_ii [kg m^2]; 1 for locked joints."""
    matrix = inertia_matrix(arm, qpos)
    columns = [solve_free(matrix, unit, jnp.ones(MAX_JOINTS))[i] for i, unit in enumerate(jnp.eye(MAX_JOINTS))]
    return 1 / jnp.stack(columns)


def torque_scale(arm: ArmArrays, action_scale: float, control_dt: float) -> Float[Array, " joints"]:
    """Maximum torque of each joint [N m], see `mimic.arms.arm.torque_scale`; 0 for locked joints."""
    torque = action_scale * SPEED_FACTOR * arm.velocity_limit * effective_inertia(arm, arm.home) / control_dt
    return arm.is_free * jnp.minimum(torque, arm.torque_limit)


def reachable_targets(arm: ArmArrays, qpos: Float[Array, " joints"], targets: Targets, control_dt: float) -> Targets:
    """The targets, or the part of the way to them that one step at the velocity limit reaches.

    Where a target is farther, the velocity at the end of the step is the largest from which the joint can brake.
    """
    limit = arm.velocity_limit
    way = targets.qpos - qpos
    step = jnp.clip(way, -control_dt * limit, control_dt * limit)
    remaining = way - step
    braking = jnp.sqrt(2 * _BRAKING * limit / control_dt * jnp.abs(remaining))
    qvel = targets.qvel + jnp.sign(remaining) * braking
    return Targets(qpos + step, jnp.clip(qvel, -limit, limit))


def tracking_torque(
    arm: ArmArrays,
    qpos: Float[Array, " joints"],
    qvel: Float[Array, " joints"],
    targets: Targets,
    max_torque: Float[Array, " joints"],
    control_dt: float,
) -> Float[Array, " joints"]:
    """The constant torque [N m] that brings the joints to targets, by inverse dynamics at the middle of the step.

    The acceleration minimises (angle error)^2 + w (velocity error)^2 dt^2 at the end of the step. If a torque is above
    its maximum, all are reduced by the same factor, so that their direction stays.

    Args:
      arm: the arm.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s].
      targets: see `Targets`; those beyond reach in one step are approached.
      max_torque: [joints] maximum torque [N m].
      control_dt: duration of the step [s].

    Returns:
      Torques, 0 for locked joints.
    """
    targets = reachable_targets(arm, qpos, targets, control_dt)
    dt, weight = control_dt, _VELOCITY_WEIGHT
    angle_error, velocity_error = targets.qpos - qpos - dt * qvel, targets.qvel - qvel
    acceleration = (0.5 * angle_error + weight * dt * velocity_error) / (dt**2 * (0.25 + weight))
    acceleration = arm.is_free * acceleration
    middle = qpos + 0.5 * dt * qvel + 0.125 * dt**2 * acceleration, qvel + 0.5 * dt * acceleration
    torque = torque_of_arm(arm, *middle, acceleration)
    excess = jnp.max(jnp.abs(torque) / jnp.maximum(max_torque, 1e-6) * arm.is_free)
    return torque / jnp.maximum(excess, 1.0)
