"""Thresholds of the safety layer."""

import dataclasses
import math
import numbers

from mimic.deploy.path import HOLD

# Minima and steps of whole numbers. Until a target acts, its path is predicted in steps of HOLD periods.
_WHOLE = {"check_periods": (HOLD, HOLD), "repeats": (0, 1), "velocity_periods": (1, 1)}
_FRACTIONS = "velocity_scale", "acceleration_scale", "min_stiffness"


@dataclasses.dataclass(frozen=True)
class SafetyConfig:
    """Thresholds of the safety layer.

    Attributes:
      margin: minimum clearance of the reference along a path [m]. It covers the tracking error of the arm, the motion
        between two points of a path that are checked, and the error of the path.
      measured_margin: clearance of the measured pose at which the arm stops [m].
      creep: part of the margin that rounding may use up [m], so that an arm at the margin can move away.
      grace: time that a target acts beyond its tick [s], for a policy that is a few milliseconds late.
      check_periods: periods that the check of a target takes, over which its computation is spread; even.
      repeats: ticks in a row without an action in which the last one is used again.
      start_distance: maximum deviation of a joint from the start pose [rad].
      start_speed: maximum speed of a joint at the start [rad/s].
      jump: maximum change of a measured angle in a period [rad].
      tracking: maximum difference between a measured angle and the reference [rad].
      position: distance from the ends of a joint's range at which the arm stops [rad].
      velocity: fraction of the velocity limit at which the arm stops.
      slow_down: fraction of the velocity limit beyond which a torque brakes a joint in addition, because an arm that
        accelerates overshoots its reference's velocity. It also brakes a joint that leaves the range of its reference.
      velocity_scale, acceleration_scale: factors on the limits of the reference; noise and payloads add to its
        velocity. Smaller ones are for first trials of a controller.
      min_stiffness: of joint_impedance, as a fraction: softer arms leave the path that was checked.
      velocity_periods: periods in a row beyond that fraction: noise does not stop the arm.

    Raises:
      ValueError: a threshold is negative or not finite, a scale or `min_stiffness` is not above 0 and at most 1, or a
        number of periods or ticks is not whole, too small, or odd where it must be even.
    """

    margin: float = 0.02
    measured_margin: float = 0.005
    creep: float = 0.005
    grace: float = 0.02
    check_periods: int = 20
    repeats: int = 2
    start_distance: float = 0.05
    start_speed: float = 0.1
    jump: float = 0.05
    tracking: float = 0.2
    position: float = 0.005
    velocity: float = 0.985
    slow_down: float = 0.92
    velocity_scale: float = 0.96
    acceleration_scale: float = 1.0
    min_stiffness: float = 0.5
    velocity_periods: int = 3

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            number = float(value) if isinstance(value, numbers.Real) else math.nan
            if name in _WHOLE:
                least, step = _WHOLE[name]
                expected = f"one of {least}, {least + step}, {least + 2 * step}, ..."
                is_valid = isinstance(value, int) and number >= least and number % step == 0
            elif name in _FRACTIONS:
                expected, is_valid = "a number above 0, at most 1", 0 < number <= 1
            else:
                expected, is_valid = "a finite number, at least 0", 0 <= number < math.inf
            if not is_valid:
                raise ValueError(f"SafetyConfig: {name}: expected {expected}, got {value!r:.40}")
