"""Thresholds of the safety layer."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class SafetyConfig:
    """Thresholds of the safety layer.

    Attributes:
      margin: minimum clearance of the reference along a path [m]. It covers the tracking error of the arm, the motion
        between two points of a path that are checked, and the error of the path.
      measured_margin: clearance of the measured pose at which the arm stops [m].
      creep: part of the margin that rounding may use up [m], so that an arm at the margin can move away.
      grace: time that a target acts beyond its tick [s], for a policy that is a few milliseconds late.
      check_periods: periods that the check of a target takes, over which its computation is spread.
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
