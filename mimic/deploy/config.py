"""Thresholds of the safety layer."""

import dataclasses
import math
import numbers

_FRACTIONS = "velocity_scale", "acceleration_scale"


@dataclasses.dataclass(frozen=True)
class SafetyConfig:
    """Thresholds of the safety layer.

    Attributes:
      margin: minimum clearance of the reference along a path [m]. It covers the tracking error of the arm and its
        motion between two samples of a path.
      measured_margin: clearance of the measured pose at which the arm stops [m].
      creep: part of the margin that rounding may use up [m], so that an arm at the margin can move away.
      latency: from a measurement until its action acts [s], a multiple of 10 ms: the policy and the check of its target
        must take less. Training has 20 ms.
      repeats: ticks in a row without an action in which the last one is used again.
      start_distance: maximum deviation of a joint from the start pose [rad].
      start_speed: maximum speed of a joint at the start [rad/s].
      tracking: maximum difference between a measured angle and the reference [rad].
      position: distance from the ends of a joint's range at which the arm stops [rad].
      velocity_scale, acceleration_scale: factors on the limits of the reference; noise and payloads add to its
        velocity. Smaller ones are for first trials of a controller.

    Raises:
      ValueError: a threshold is negative or not finite, a scale is not above 0 and at most 1, or `repeats` is not
        whole.
    """

    margin: float = 0.02
    measured_margin: float = 0.005
    creep: float = 0.005
    latency: float = 0.02
    repeats: int = 2
    start_distance: float = 0.05
    start_speed: float = 0.1
    tracking: float = 0.2
    position: float = 0.005
    velocity_scale: float = 0.9
    acceleration_scale: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            number = float(value) if isinstance(value, numbers.Real) else math.nan
            if name == "repeats":
                expected, is_valid = "one of 0, 1, 2, ...", isinstance(value, int) and value >= 0
            elif name in _FRACTIONS:
                expected, is_valid = "a number above 0, at most 1", 0 < number <= 1
            else:
                expected, is_valid = "a finite number, at least 0", 0 <= number < math.inf
            if not is_valid:
                raise ValueError(f"SafetyConfig: {name}: expected {expected}, got {value!r:.40}")
