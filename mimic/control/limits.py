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

# Critically damped PD control at this frequency: an angular acceleration of 10 rad/s^2 costs 6 mrad, and a period of
# 1 ms is short against it.
FREQUENCY = 40.0  # rad/s
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
    limits: JointLimits, inertia: np.ndarray, torque_scale: np.ndarray, control_dt: float
) -> JointParameters:
    """Working limits and gains of the inner loop.

    Args:
      limits: the manufacturer's.
      inertia: [joints] effective inertia of each joint in the home pose [kg m^2], for the gains.
      torque_scale: [joints] torque of the action 1 in the mode "torque" [N m].
      control_dt: tick of the policy [s].
    """
    velocity = VELOCITY_FRACTION * limits.velocity
    lower, upper = limits.position.T
    return JointParameters(
        lower=lower + POSITION_MARGIN,
        upper=upper - POSITION_MARGIN,
        velocity=velocity,
        acceleration=ACCELERATION_FRACTION * limits.acceleration,
        jerk=JERK_FRACTION * limits.jerk,
        torque=TORQUE_FRACTION * limits.torque,
        torque_rate=TORQUE_FRACTION * limits.torque_rate,
        stiffness=inertia * FREQUENCY**2,
        damping=2 * inertia * FREQUENCY,
        torque_scale=np.asarray(torque_scale, float),
        # At a constant velocity a reference lags 1 / APPROACH_RATE behind its target.
        reach=velocity * (control_dt + 2 / APPROACH_RATE),
    )
