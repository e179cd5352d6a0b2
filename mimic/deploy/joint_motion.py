"""The motion of one joint's reference and the torque that tracks it, with Python's numbers.

They are `next_reference` and `joint_torque` of `mimic.control.joint_control`. For the few joints of one arm, numbers
take less than half of the time of operations on arrays, and run less code, which the processor often does not have in
its caches. For many robots they take more.
"""

from collections.abc import Iterable, Sequence
from math import sqrt
from typing import Any, NamedTuple

import numpy as np

from mimic.control.joint_control import (
    APPROACH_RATE,
    BRAKING_FRACTION,
    PERIOD,
    REACTION_FRACTION,
    VELOCITY_RATE,
    Approach,
    JointParameters,
    Reference,
    approach,
)

State = tuple[float, float, float]  # angle, velocity and acceleration of a reference


class _Step(NamedTuple):
    """Constants of steps of one length.

    Attributes:
      time: length [s].
      mean_time: mean time for which a change of the velocity in the step acts [s].
      max_change: of the acceleration in a step [rad/s^2].
      swing_time: by how much a change of the acceleration delays that of the velocity, for its square [s^3/rad].
      approach: of a velocity.
    """

    time: float
    mean_time: float
    max_change: float
    swing_time: float
    approach: Approach


class JointMotion(NamedTuple):
    """Constants of a joint: see `ReferenceLimits`; `approach` of an angle, and of the steps of each length."""

    lower: float
    upper: float
    velocity: float
    acceleration: float
    reaction: float
    approach: Approach
    steps: dict[int, _Step]


class JointTorque(NamedTuple):
    """Constants of the torque of a joint, see `JointParameters`.

    Attributes:
      lower, upper, inertia, friction, torque: as there.
      change: maximum of the torque in a period [N m].
      slow: speed beyond which the joint is braked in addition [rad/s].
      slowing: damping of that [N m s/rad].
    """

    lower: float
    upper: float
    inertia: float
    friction: float
    torque: float
    change: float
    slow: float
    slowing: float


def joint_numbers(arrays: Iterable[np.ndarray]) -> list[Any]:
    """A tuple of the numbers of some arrays [joints, robots] for each joint of each robot."""
    return list(zip(*(x.ravel().tolist() for x in arrays), strict=True))


def joint_reference(states: Sequence[State], size: tuple[int, int]) -> Reference:
    """The inverse of `joint_numbers`: references [joints, robots] of that size."""
    return Reference(*np.array(states).T.reshape(3, *size))


def joint_motion(joint: JointParameters, *periods: int) -> JointMotion:
    """The constants of a joint from its parameters, numbers, for steps of some numbers of periods."""
    return JointMotion(
        joint.lower,
        joint.upper,
        joint.velocity,
        joint.acceleration,
        REACTION_FRACTION * joint.acceleration / joint.jerk,
        approach(BRAKING_FRACTION * joint.acceleration, APPROACH_RATE),
        {
            length: _Step(
                length * PERIOD,
                0.5 * (length * PERIOD + PERIOD),
                joint.jerk * length * PERIOD,
                1 / (2 * joint.jerk) if length > 1 else 0.0,
                approach(BRAKING_FRACTION * joint.jerk, _rate(length)),
            )
            for length in periods
        },
    )


def _rate(periods: int) -> float:
    """The rate that gives the decay of VELOCITY_RATE over some periods in one step."""
    return (1 - (1 - VELOCITY_RATE * PERIOD) ** periods) / (periods * PERIOD)


def moved(
    state: State, count: int, joint: JointMotion, periods: int, target: float | None, *, is_position: bool = False
) -> tuple[State, list[float]]:
    """Some steps of a reference as in `next_reference`, and its angle after each of them.

    A step of one period is that of the inner loop; larger ones approximate it.

    Args:
      state: of the reference.
      count: number of steps.
      joint: constants.
      periods: in a step.
      target: that acts; None where the joint stops.
      is_position: whether the target is an angle.
    """
    # Conditions in place of min and max, and `approach_speed` written out: calls would take twice as long.
    qpos, qvel, qacc = state
    lower, upper, max_speed, max_qacc, reaction, (slope, offset, rate), steps = joint
    time, mean_time, max_change, swing_time, (swing_slope, swing_offset, swing_rate) = steps[periods]
    speed, angles = 0.0, []
    for _ in range(count):
        ahead = qpos + reaction * qvel  # where the joint would stop
        if target is None:
            speed = 0.0
        elif is_position:
            error = target - ahead
            far = slope * (error if error > 0 else -error) - offset
            far = sqrt(far if far > offset else offset)
            speed = rate * error
            if speed > far:
                speed = far
            elif speed < -far:
                speed = -far
        else:
            speed = target
        if speed > 0 or ahead > upper:
            room = upper - ahead
            far = slope * room - offset
            far = sqrt(far if far > offset else offset)
            near = rate * room
            if speed > near:
                speed = near
            if speed > far:
                speed = far
            if speed > max_speed:
                speed = max_speed
        if speed < 0 or ahead < lower:
            room = ahead - lower
            far = slope * room - offset
            far = -sqrt(far if far > offset else offset)
            near = -rate * room
            if speed < near:
                speed = near
            if speed < far:
                speed = far
            if speed < -max_speed:
                speed = -max_speed
        change = speed - qvel
        far = swing_slope * (change if change > 0 else -change) - swing_offset
        far = sqrt(far if far > swing_offset else swing_offset)
        if far > max_qacc:
            far = max_qacc
        swing = swing_rate * change
        if swing > far:
            swing = far
        elif swing < -far:
            swing = -far
        swing -= qacc
        if swing > max_change:
            swing = max_change
        elif swing < -max_change:
            swing = -max_change
        qacc += swing
        change = qacc * time - (swing if swing > 0 else -swing) * swing * swing_time  # the jerk limit delays a part
        # The angle moves at the mean of the velocities after each period.
        qpos += qvel * time + change * mean_time
        qvel += change
        angles.append(qpos)
    return (qpos, qvel, qacc), angles


def tracking_torque(
    qpos: float, qvel: float, state: State, gains: tuple[float, float], previous: float, joint: JointTorque
) -> float:
    """The torque of one period as in `joint_torque` [N m].

    It also brakes a joint that is faster than `slow`, or beyond the range of its reference and on its way out.

    Args:
      qpos, qvel: measured [rad, rad/s].
      state: of the reference.
      gains: stiffness and damping [N m/rad, N m s/rad].
      previous: torque of the last period [N m].
      joint: constants.
    """
    reference, speed, qacc = state
    lower, upper, inertia, friction, most, change, slow, slowing = joint
    torque = gains[0] * (reference - qpos) + gains[1] * (speed - qvel) + inertia * qacc + friction * speed
    torque = previous + _bounded(_bounded(torque, most) - previous, change)
    if qvel > slow or qvel < -slow or qpos > upper or qpos < lower:
        is_leaving = (qvel > 0 and qpos > upper) or (qvel < 0 and qpos < lower)
        excess = qvel if is_leaving else qvel - _bounded(qvel, slow)
        torque = previous + _bounded(_bounded(torque - slowing * excess, most) - previous, change)
    return torque


def _bounded(value: float, bound: float) -> float:
    return bound if value > bound else -bound if value < -bound else value
