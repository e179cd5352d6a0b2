"""Torques of any arm that bring its joints to target angles at the end of a control step, within its limits."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.arm import SPEED_FACTOR
from mimic.arms.arrays import MAX_JOINTS, ArmArrays
from mimic.physics.dynamics import inertia_and_bias, inertia_matrix
from mimic.retargeting.array_nearest import NearestPose, solve_free

# Weight of the velocity at the end of a step against the angle there, in units of the step. Without it the velocity
# would alternate from step to step; 0.05 to 1 give optimality gaps of 0.14 to 0.17 % on panda4dof.
_VELOCITY_WEIGHT = 0.15
# The deceleration that is counted on, as a fraction of the velocity limit that is lost in a control step.
_BRAKING = 0.3
# Maximum speed without limits, in velocity limits: 1, 1.5, 2 and 3 give mean gaps of real arms of 7.0, 5.4, 4.8, 4.8 %.
_UNLIMITED_SPEED = 3.0
_MAX_CHANGE = 2.0  # largest change of an acceleration by an action, in velocity limits per control step


def effective_inertia(arm: ArmArrays, qpos: Float[Array, " joints"]) -> Float[Array, " joints"]:
    """Effective inertia of each joint while the others are free, 1 / (M^-1)_ii [kg m^2]; 1 for locked joints."""
    matrix = inertia_matrix(arm, qpos)
    columns = [solve_free(matrix, unit, jnp.ones(MAX_JOINTS))[i] for i, unit in enumerate(jnp.eye(MAX_JOINTS))]
    return 1 / jnp.stack(columns)


def torque_scale(arm: ArmArrays, action_scale: float, control_dt: float) -> Float[Array, " joints"]:
    """Maximum torque of each joint [N m], see `mimic.arms.arm.torque_scale`; 0 for locked joints."""
    torque = action_scale * SPEED_FACTOR * arm.velocity_limit * effective_inertia(arm, arm.home) / control_dt
    return arm.is_free * jnp.minimum(torque, arm.torque_limit)


def max_speed(arm: ArmArrays, limits: str) -> Float[Array, " joints"]:
    """The speed that a controller uses at most [rad/s].

    Args:
      arm: the arm.
      limits: see `EnvConfig`; with "none" nothing keeps an arm within its velocity limit, nor does the reward.
    """
    return (1.0 if limits == "hardware" else _UNLIMITED_SPEED) * arm.velocity_limit


def reachable_targets(
    qpos: Float[Array, " joints"], targets: NearestPose, speed: Float[Array, " joints"], control_dt: float
) -> NearestPose:
    """The targets, or the part of the way to them that one step at the maximum speed reaches.

    Where a target is farther, the velocity at the end of the step is the largest from which the joint can brake.
    """
    way = targets.qpos - qpos
    step = jnp.clip(way, -control_dt * speed, control_dt * speed)
    remaining = way - step
    braking = jnp.sqrt(2 * _BRAKING * speed / control_dt * jnp.abs(remaining))
    qvel = targets.qvel + jnp.sign(remaining) * braking
    return targets._replace(qpos=qpos + step, qvel=jnp.clip(qvel, -speed, speed))


def tracking_acceleration(
    arm: ArmArrays,
    qpos: Float[Array, " joints"],
    qvel: Float[Array, " joints"],
    targets: NearestPose,
    speed: Float[Array, " joints"],
    control_dt: float,
) -> Float[Array, " joints"]:
    """The constant acceleration [rad/s^2] that brings the joints to targets, 0 for locked joints.

    It minimises (angle error)^2 + w (velocity error)^2 dt^2 at the end of the step.

    Args:
      arm: the arm.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s].
      targets: where the joints should be at the end of the step; those beyond reach in one step are approached.
      speed: maximum speed of each joint [rad/s], see `max_speed`.
      control_dt: duration of the step [s].
    """
    targets = reachable_targets(qpos, targets, speed, control_dt)
    dt, weight = control_dt, _VELOCITY_WEIGHT
    angle_error, velocity_error = targets.qpos - qpos - dt * qvel, targets.qvel - qvel
    return arm.is_free * (0.5 * angle_error + weight * dt * velocity_error) / (dt**2 * (0.25 + weight))


class Plan(NamedTuple):
    """What the controller does in a step, and the dynamics at its middle, which turn a change of it into torques.

    Attributes:
      acceleration: [joints] of the joints, constant [rad/s^2].
      inertia: [joints, joints] torques per unit of acceleration: inertia, and damping of half a step [kg m^2].
      bias: [joints] torques of zero acceleration [N m].
    """

    acceleration: Float[Array, " joints"]
    inertia: Float[Array, "joints joints"]
    bias: Float[Array, " joints"]

    def torque(self, acceleration: Float[Array, " joints"]) -> Float[Array, " joints"]:
        """The torques of another acceleration [N m]; those of locked joints have no meaning."""
        return jnp.sum(self.inertia * acceleration, axis=1) + self.bias


def make_plan(
    arm: ArmArrays,
    qpos: Float[Array, " joints"],
    qvel: Float[Array, " joints"],
    targets: NearestPose,
    speed: Float[Array, " joints"],
    control_dt: float,
) -> Plan:
    """The plan of a step towards targets, see `tracking_acceleration`."""
    dt = control_dt
    acceleration = tracking_acceleration(arm, qpos, qvel, targets, speed, dt)
    middle = qpos + 0.5 * dt * qvel + 0.125 * dt**2 * acceleration, qvel + 0.5 * dt * acceleration
    inertia, bias = inertia_and_bias(arm, *middle)
    drag = 0.5 * dt * arm.is_free * arm.damping  # torque at the middle of the step per unit of acceleration
    return Plan(acceleration, inertia + jnp.diag(drag), bias - drag * acceleration)


def planned_torque(
    arm: ArmArrays,
    plan: Plan,
    action: Float[Array, " joints"],
    max_torque: Float[Array, " joints"],
    control_dt: float,
) -> Float[Array, " joints"]:
    """The constant torque [N m] of a plan, within limits; 0 for locked joints.

    If a torque is above its maximum, all are reduced by the same factor, so that their direction stays: if each were
    cut by itself, the light joints would be thrown about by the others.

    Args:
      arm: the arm.
      plan: of the step.
      action: change of the acceleration by a policy, in [-1, 1]: 1 is two velocity limits in a control step.
      max_torque: [joints] maximum torque [N m].
      control_dt: duration of the step [s].
    """
    change = _MAX_CHANGE * arm.velocity_limit / control_dt * jnp.clip(action, -1.0, 1.0)
    torque = arm.is_free * plan.torque(arm.is_free * (plan.acceleration + change))
    excess = jnp.max(jnp.abs(torque) / jnp.maximum(max_torque, 1e-6) * arm.is_free)
    return torque / jnp.maximum(excess, 1.0)
