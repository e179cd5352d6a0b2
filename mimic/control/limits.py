"""Limits of a robot's joints, as its manufacturer states them, and the parameters of the inner loop that follow."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from mimic.control.joint_control import (
    ACCELERATION_FRACTION,
    APPROACH_RATE,
    JERK_FRACTION,
    POSITION_MARGIN,
    TORQUE_FRACTION,
    VELOCITY_FRACTION,
    JointParameters,
)

# Critically damped PD control at this frequency. The stiffness of a Panda is then 1400 to 40 N m/rad, from base to tip;
# examples of its manufacturer have 600 to 50. Faster control would need a torque rate beyond the limit.
FREQUENCY = 20.0  # rad/s
TORQUE_RATE_FRACTION = 0.6  # of the maximum torque rate, which the jerk of the reference may need
TRAJECTORY_JERK = 8.0  # of that of the inner loop, within which trajectories reach the ends of its paths in time
# Where a model states no limits of acceleration, jerk and torque rate, they follow from the times that a Panda needs.
_SECONDS_TO_VELOCITY, _SECONDS_TO_ACCELERATION, _SECONDS_TO_TORQUE = 0.25, 0.002, 0.087


@dataclasses.dataclass(frozen=True)
class JointLimits:
    """The manufacturer's limits, [joints] each.

    Attributes:
      position: [joints, 2] minimum and maximum angle [rad].
      velocity: [rad/s].
      acceleration: [rad/s^2].
      jerk: [rad/s^3].
      torque: [N m].
      torque_rate: [N m/s].
    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray
    torque: np.ndarray
    torque_rate: np.ndarray

    def as_lists(self) -> dict[str, Any]:
        """The limits as lists, for JSON."""
        return {field.name: getattr(self, field.name).tolist() for field in dataclasses.fields(self)}

    @classmethod
    def from_lists(cls, lists: Mapping[str, Any]) -> "JointLimits":
        """The inverse of `as_lists`."""
        return cls(**{field.name: np.asarray(lists[field.name], float) for field in dataclasses.fields(cls)})


def joint_limits(
    position: np.ndarray,
    velocity: np.ndarray,
    torque: np.ndarray,
    acceleration: np.ndarray | None = None,
    jerk: np.ndarray | None = None,
    torque_rate: np.ndarray | None = None,
) -> JointLimits:
    """The limits of an arm; those that its model does not state, which are None, follow from the others."""
    velocity, torque = np.asarray(velocity, float), np.asarray(torque, float)
    acceleration = velocity / _SECONDS_TO_VELOCITY if acceleration is None else np.asarray(acceleration, float)
    jerk = acceleration / _SECONDS_TO_ACCELERATION if jerk is None else np.asarray(jerk, float)
    torque_rate = torque / _SECONDS_TO_TORQUE if torque_rate is None else np.asarray(torque_rate, float)
    return JointLimits(np.asarray(position, float), velocity, acceleration, jerk, torque, torque_rate)


def joint_parameters(
    limits: JointLimits,
    inertia: tuple[np.ndarray, np.ndarray],
    friction: np.ndarray,
    torque_scale: np.ndarray,
    control_dt: float,
) -> JointParameters:
    """Working limits and gains of the inner loop.

    The jerk is also limited so that the torque can follow: a controller whose torque lags behind is unstable.

    Args:
      limits: the manufacturer's.
      inertia: [joints] inertia about each joint in the home pose, and in the worst pose with the heaviest payload
        [kg m^2].
      friction: [joints] viscous friction [N m s/rad].
      torque_scale: [joints] torque of the action 1 in the mode "torque" [N m].
      control_dt: tick of the policy [s].
    """
    velocity = VELOCITY_FRACTION * limits.velocity
    largest, typical = inertia[1], (inertia[0] + inertia[1]) / 2
    lower, upper = limits.position.T
    torque_rate = TORQUE_FRACTION * limits.torque_rate
    jerk = np.minimum(JERK_FRACTION * limits.jerk, TORQUE_RATE_FRACTION * torque_rate / largest)
    return JointParameters(
        lower=lower + POSITION_MARGIN,
        upper=upper - POSITION_MARGIN,
        velocity=velocity,
        acceleration=ACCELERATION_FRACTION * limits.acceleration,
        jerk=jerk,
        torque=TORQUE_FRACTION * limits.torque,
        torque_rate=torque_rate,
        inertia=typical,
        friction=np.asarray(friction, float),
        stiffness=typical * FREQUENCY**2,
        damping=2 * typical * FREQUENCY,
        torque_scale=np.asarray(torque_scale, float),
        # At a constant velocity a reference lags 1 / APPROACH_RATE behind its target.
        reach=velocity * (control_dt + 2 / APPROACH_RATE),
    )


def trajectory_limits(limits: JointLimits, parameters: JointParameters) -> JointLimits:
    """Limits of a robot's own trajectories to targets that the inner loop's reference reaches at each tick.

    With less acceleration or jerk they come late; with all of the jerk the torque cannot follow, and an arm overshoots
    its velocity.

    Args:
      limits: the manufacturer's.
      parameters: of the inner loop.
    """
    jerk = np.minimum(limits.jerk, TRAJECTORY_JERK * parameters.jerk)
    return dataclasses.replace(limits, velocity=np.asarray(parameters.velocity), jerk=jerk)
