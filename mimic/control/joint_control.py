"""The inner loop of a joint controller: from a policy's target to a reference motion within limits, and to torques.

Every function is elementwise. `xp` is the array library of its arguments, `numpy` or `jax.numpy`.
"""

from typing import Any, NamedTuple

Array = Any

MODES = ("torque", "joint_position", "joint_velocity")
PERIOD = 0.001  # s, of the inner loop: that of the robots' interfaces, such as libfranka's
# The working limits are these fractions of the manufacturer's: the arm itself exceeds its reference's speed and torque.
VELOCITY_FRACTION, ACCELERATION_FRACTION, JERK_FRACTION, TORQUE_FRACTION = 0.95, 0.4, 0.9, 0.95
POSITION_MARGIN = 0.03  # rad: a reference stays this far inside the joint range
BRAKING_FRACTION = 0.7  # of the working acceleration and jerk, with which a reference slows down before a target
APPROACH_RATE = 12.0  # 1/s: near its target angle a reference approaches it exponentially
VELOCITY_RATE = 50.0  # 1/s: the same for velocities; above 4 APPROACH_RATE, so that nothing overshoots
REACTION_FRACTION = 1.0  # of the time in which a reference reaches its full acceleration


class Reference(NamedTuple):
    """The motion that the inner loop tracks.

    Attributes:
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s].
      qacc: joint accelerations [rad/s^2].
    """

    qpos: Array
    qvel: Array
    qacc: Array


class JointParameters(NamedTuple):
    """Working limits and gains of the inner loop, one number for each joint.

    Attributes:
      lower, upper: range of the reference's angle [rad].
      velocity, acceleration, jerk: maxima of the reference [rad/s, rad/s^2, rad/s^3].
      torque: maximum torque [N m].
      torque_rate: maximum change of the torque [N m/s].
      inertia, friction: for the torque that moves the joint as the reference moves, in proportion to its acceleration
        and velocity [kg m^2, N m s/rad].
      stiffness: [N m/rad].
      damping: [N m s/rad].
      torque_scale: torque of the action 1 in the mode "torque" [N m].
      reach: displacement of the target of the action 1 in the modes of a target position [rad].
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    torque: Array
    torque_rate: Array
    inertia: Array
    friction: Array
    stiffness: Array
    damping: Array
    torque_scale: Array
    reach: Array


class Approach(NamedTuple):
    """Constants of `approach_speed`, see `approach`.

    Attributes:
      slope: change of the squared speed with the distance.
      offset: square of the speed where the exponential approach begins.
      rate: of the exponential approach [1/s].
    """

    slope: Array
    offset: Array
    rate: Array


class ReferenceLimits(NamedTuple):
    """Limits of a reference, and what follows from them, one number for each joint.

    Attributes:
      lower, upper, velocity, acceleration: see `JointParameters`.
      acceleration_change: maximum in a period [rad/s^2].
      reaction: until the reference brakes, because its jerk is limited [s].
      position, speed: of the approach to an angle, and to a velocity.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    acceleration_change: Array
    reaction: Array
    position: Approach
    speed: Approach


def action_target(mode: str, action: Array, reference: Reference, joints: JointParameters, xp: Any) -> Array:
    """The target of an action in [-1, 1]: velocity [rad/s], angle [rad] or torque [N m], as the mode says.

    "joint_velocity": as a fraction of the working limit. "joint_position": displacement of the target angle from the
    reference, as a fraction of `reach`. "torque": as a fraction of `torque_scale`.

    Args:
      mode: one of `MODES`.
      action: a number for each joint.
      reference: at the start of the tick.
      joints: parameters, [joints] each.
      xp: array library.
    """
    action = xp.maximum(xp.minimum(action, 1.0), -1.0)
    if mode == "torque":
        return action * joints.torque_scale
    if mode == "joint_velocity":
        return action * joints.velocity
    return xp.maximum(xp.minimum(reference.qpos + action * joints.reach, joints.upper), joints.lower)


def action_towards(mode: str, displacement: Array, duration: Any, joints: JointParameters, xp: Any) -> Array:
    """The action that moves a reference towards an angle, [..., joints] in [-1, 1]: see `action_target`.

    Args:
      mode: "joint_velocity", which commands the velocity that is there after `duration`, or "joint_position".
      displacement: from the reference to the angle, [..., joints] [rad].
      duration: [s].
      joints: parameters, [joints] each.
      xp: array library.
    """
    assert mode in MODES and mode != "torque", mode
    reach = duration * joints.velocity if mode == "joint_velocity" else joints.reach
    return xp.clip(displacement / reach, -1.0, 1.0)


def reference_limits(joints: JointParameters, period: float = PERIOD) -> ReferenceLimits:
    """The constants of `next_reference`.

    Args:
      joints: parameters.
      period: [s].
    """
    return ReferenceLimits(
        lower=joints.lower,
        upper=joints.upper,
        velocity=joints.velocity,
        acceleration=joints.acceleration,
        acceleration_change=joints.jerk * period,
        reaction=REACTION_FRACTION * joints.acceleration / joints.jerk,
        position=approach(BRAKING_FRACTION * joints.acceleration, APPROACH_RATE),
        speed=approach(BRAKING_FRACTION * joints.jerk, VELOCITY_RATE),
    )


def approach(acceleration: Array, rate: float) -> Approach:
    """The constants of `approach_speed`.

    Args:
      acceleration: deceleration.
      rate: of the exponential approach [1/s].
    """
    return Approach(2.0 * acceleration, acceleration * acceleration / rate**2, rate)


def approach_speed(distance: Array, approach: Approach, xp: Any) -> Array:
    """Speed at which a value may approach a point so that it can stop there; negative beyond the point.

    Exponential within the last acceleration / rate^2, a constant deceleration before, with the same slope where they
    meet: so it is the smaller one of the two.

    Args:
      distance: to the point.
      approach: constants.
      xp: array library.
    """
    return xp.minimum(approach.rate * distance, _braking_speed(distance, approach, xp))


def _braking_speed(distance: Array, approach: Approach, xp: Any) -> Array:
    """Speed of a constant deceleration; near the point that where the exponential approach begins."""
    return xp.sqrt(xp.maximum(approach.slope * distance - approach.offset, approach.offset))


def next_reference(
    mode: str, reference: Reference, target: Array, limits: ReferenceLimits, xp: Any, period: float = PERIOD
) -> Reference:
    """Moves a reference by one period, within the limits on angle, velocity, acceleration and jerk.

    Args:
      mode: "joint_velocity", where the target is a velocity; else it is an angle. To stop a reference in any mode, use
        the mode "joint_velocity" and the target 0.
      reference: the last one.
      target: angle [rad] or velocity [rad/s].
      limits: from `reference_limits`, of the same period.
      xp: array library.
      period: [s].
    """
    position, velocity = limits.position, limits.speed
    ahead = reference.qpos + limits.reaction * reference.qvel
    if mode == "joint_velocity":
        speed = _bounded(target, limits.velocity, xp)
    else:
        error = target - ahead
        most = xp.minimum(_braking_speed(xp.abs(error), position, xp), limits.velocity)
        speed = _bounded(position.rate * error, most, xp)
    speed = xp.minimum(speed, approach_speed(limits.upper - ahead, position, xp))
    speed = xp.maximum(speed, -approach_speed(ahead - limits.lower, position, xp))
    change = speed - reference.qvel
    most = xp.minimum(_braking_speed(xp.abs(change), velocity, xp), limits.acceleration)
    qacc = _bounded(velocity.rate * change, most, xp)
    qacc = reference.qacc + _bounded(qacc - reference.qacc, limits.acceleration_change, xp)
    qvel = reference.qvel + period * qacc
    return Reference(reference.qpos + period * qvel, qvel, qacc)


def joint_torque(
    mode: str,
    qpos: Array,
    qvel: Array,
    reference: Reference,
    target: Array,
    previous: Array,
    joints: JointParameters,
    xp: Any,
) -> Array:
    """Torque of one period [N m], in addition to gravity compensation: PD control of the reference, within limits.

    Args:
      mode: one of `MODES`; in "torque" the target is the torque.
      qpos: measured joint angles [rad].
      qvel: measured joint velocities [rad/s].
      reference: the motion to track.
      target: of the policy; only that of the mode "torque" is used.
      previous: torque of the last period [N m].
      joints: parameters.
      xp: array library.
    """
    if mode == "torque":
        torque = target
    else:
        torque = joints.stiffness * (reference.qpos - qpos) + joints.damping * (reference.qvel - qvel)
        torque = torque + joints.inertia * reference.qacc + joints.friction * reference.qvel
    torque = _bounded(torque, joints.torque, xp)
    return previous + _bounded(torque - previous, joints.torque_rate * PERIOD, xp)


def friction_torque(qvel: Array, level: Array, rate: Array, xp: Any) -> Array:
    """Friction torque against the motion of a joint, level * tanh(rate * qvel) [N m].

    Args:
      qvel: joint velocities [rad/s].
      level: at high speed [N m].
      rate: [s/rad].
      xp: array library.
    """
    # The tanh of CUDA's library has a branch. The bound keeps the exponential finite, where tanh is 1.
    growth = xp.exp(2.0 * _bounded(rate * qvel, 20.0, xp))
    return level * (1.0 - 2.0 / (1.0 + growth))


def _bounded(value: Array, bound: Array, xp: Any) -> Array:
    return xp.maximum(xp.minimum(value, bound), -bound)  # several times faster than NumPy's clip
