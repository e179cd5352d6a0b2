"""Predicts where a reference goes under a target and then brakes: `next_reference` with larger steps, in place."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mimic.control.joint_control import (
    APPROACH_RATE,
    BRAKING_FRACTION,
    PERIOD,
    REACTION_FRACTION,
    VELOCITY_RATE,
    JointParameters,
    Reference,
    approach,
)

HOLD, BRAKE = 2, 30  # periods of a step, while targets act and while the references brake
SAMPLE = 10  # periods between two angles of a path; those in the middle of a step of braking are interpolated
_PER_BRAKE = BRAKE // SAMPLE


class PathPrediction:
    """Paths of robots' references that follow their present target, hold a new one for a time, and brake to a stop.

    Its steps are larger than those of the inner loop; the angles differ by less than `ERROR`. A path is computed in
    parts that fit between two periods.

    Args:
      joints: parameters, [joints, 1] each.
      is_position: whether targets are angles [rad]; otherwise velocities [rad/s].
      delay: periods until the new target acts, a multiple of `HOLD`.
      hold: periods for which it acts, a multiple of `SAMPLE`.
      robots: number of robots.

    Attributes:
      steps: number of steps of a path.
      samples: number of its angles.
    """

    ERROR = 0.008  # rad, maximum over the joints

    def __init__(self, joints: JointParameters, is_position: bool, delay: int, hold: int, robots: int = 1):
        self._delay_steps, self._hold_steps = delay // HOLD, (delay + hold) // HOLD
        brake_steps = braking_steps(joints)
        self.steps = self._hold_steps + brake_steps
        size = joints.lower.shape[0], robots
        self._first_brake = 1 + hold // SAMPLE
        self.samples = self._first_brake + brake_steps * _PER_BRAKE
        self._path = np.zeros((self.samples, *size))
        self._qpos, self._qvel, self._qacc, self._speed, self._a, self._b = np.zeros((6, *size))
        self._room = np.zeros((2, *size))
        self._is_position = is_position

        def full(values: Any, shape: tuple[int, ...] = size) -> np.ndarray:  # NumPy takes longer to broadcast
            return np.array(np.broadcast_to(values, shape), float)

        def approaching(acceleration: np.ndarray, rate: float, shape: tuple[int, ...] = size) -> _Approach:
            return _Approach(*(full(x, shape) for x in approach(acceleration, rate)))

        braking, pair = BRAKING_FRACTION * joints.acceleration, (2, *size)
        self._lower, self._upper = full(joints.lower), full(joints.upper)
        self._max_speeds = full(joints.velocity, pair)
        self._max_qacc = full(joints.acceleration)
        self._reaction = full(REACTION_FRACTION * joints.acceleration / joints.jerk)
        self._position, self._ends = (approaching(braking, APPROACH_RATE, shape) for shape in (size, pair))
        self._steps = {
            periods: _Step(
                full(periods * PERIOD),
                full(0.5 * (periods * PERIOD + PERIOD)),
                full(joints.jerk * periods * PERIOD),
                full(-joints.jerk * periods * PERIOD),
                approaching(BRAKING_FRACTION * joints.jerk, _rate(periods)),
            )
            for periods in (HOLD, BRAKE)
        }
        self._swing_time = full(1 / (2 * joints.jerk))
        self._target, self._left, self._first_end = np.zeros(size), np.zeros(robots, int), 0
        self._count, self._samples, self._filled = self.steps, 0, 0

    def begin(self, reference: Reference, target: np.ndarray, left: np.ndarray) -> None:
        """Starts the paths.

        Args:
          reference: at present, [joints, robots] each.
          target: that acts at present, [joints, robots].
          left: [robots] periods until its references brake.
        """
        self._qpos[:], self._qvel[:], self._qacc[:] = reference
        self._target, self._left, self._first_end = target, left.copy(), int(left.min())
        self._count, self._samples, self._filled = 0, 0, 0

    def advance(self, steps: int, new_target: Callable[[Reference], np.ndarray]) -> bool:
        """Computes some more steps; returns whether the paths are complete.

        Args:
          steps: number of them.
          new_target: gives the new target, [joints, robots], for the reference at the time when it begins to act.
        """
        for _ in range(min(steps, self.steps - self._count)):
            if self._count == self._delay_steps:
                self._target = new_target(Reference(self._qpos, self._qvel, self._qacc))
                self._sample(1)
            is_braking = self._count >= self._hold_steps
            if is_braking:
                self._brake()
            else:
                self._follow()
            self._step(self._steps[BRAKE if is_braking else HOLD])
            self._count += 1
            since = HOLD * (self._count - self._delay_steps)
            if is_braking:
                self._sample(_PER_BRAKE)
            elif since > 0 and since % SAMPLE == 0:
                self._sample(1)
        self._interpolate()
        return self._count == self.steps

    @property
    def path(self) -> np.ndarray:
        """The angles when the new target begins to act and after each `SAMPLE`, [samples, joints, robots] [rad]."""
        return self._path[: self._samples]

    def _sample(self, count: int) -> None:
        """Adds the present angles to the path as the last of some samples; those before are interpolated later."""
        self._samples += count
        self._path[self._samples - 1] = self._qpos

    def _interpolate(self) -> None:
        """Fills the samples between the ends of the steps of braking that are new."""
        first, last = max(self._filled, self._first_brake), self._samples
        if first < last:
            before, after = (
                self._path[first - 1 : last - 1 : _PER_BRAKE],
                self._path[first + _PER_BRAKE - 1 : last : _PER_BRAKE],
            )
            change = after - before
            for k in range(1, _PER_BRAKE):
                self._path[first + k - 1 : last : _PER_BRAKE] = before + k / _PER_BRAKE * change
        self._filled = last

    def _ahead(self) -> np.ndarray:
        """Where the joints would stop."""
        np.multiply(self._reaction, self._qvel, out=self._a)
        self._a += self._qpos
        return self._a

    def _brake(self) -> None:
        """The speed for the target 0: not 0 beyond the ends of the range, where joints return."""
        speed, ahead = self._speed, self._ahead()
        np.minimum(ahead, self._upper, out=speed)
        np.maximum(speed, self._lower, out=speed)
        speed -= ahead
        speed *= self._position.rate

    def _follow(self) -> None:
        """The speed for the target that acts, or 0 where none acts any more, so that joints stop at their ends."""
        speed, room, ahead = self._speed, self._room, self._ahead()
        if self._is_position:
            error = np.subtract(self._target, ahead, out=self._b)
            np.copysign(self._position(np.abs(error)), error, out=speed)
        else:
            speed[:] = self._target
        if self._first_end <= HOLD * self._count < HOLD * self._delay_steps:
            speed *= self._left > HOLD * self._count
        np.subtract(self._upper, ahead, out=room[0])
        np.subtract(ahead, self._lower, out=room[1])
        bound = self._ends(room)
        np.minimum(bound, self._max_speeds, out=bound)
        np.minimum(speed, bound[0], out=speed)
        np.maximum(speed, np.negative(bound[1], out=bound[1]), out=speed)

    def _step(self, step: "_Step") -> None:
        """A step as in `next_reference`, towards `speed`."""
        a, b = self._a, self._b
        change = np.subtract(self._speed, self._qvel, out=self._speed)
        swing = step.approach(np.abs(change, out=a))
        np.minimum(swing, self._max_qacc, out=swing)
        np.copysign(swing, change, out=swing)
        swing -= self._qacc
        np.minimum(swing, step.max_change, out=swing)
        np.maximum(swing, step.min_change, out=swing)
        self._qacc += swing
        np.multiply(self._qacc, step.time, out=a)
        np.multiply(np.abs(swing, out=b), swing, out=b)  # the jerk limit delays a part of the change
        b *= self._swing_time
        a -= b
        # The angle moves at the mean of the velocities after each period.
        self._qpos += np.multiply(self._qvel, step.time, out=b)
        self._qpos += np.multiply(a, step.mean_time, out=b)
        self._qvel += a


class _Approach(NamedTuple):
    """`approach_speed` with its constants, in few operations."""

    slope: np.ndarray
    offset: np.ndarray
    rate: np.ndarray

    def __call__(self, distance: np.ndarray) -> np.ndarray:
        far = distance * self.slope
        far -= self.offset
        np.maximum(far, self.offset, out=far)
        np.sqrt(far, out=far)
        return np.minimum(far, distance * self.rate, out=far)


class _Step(NamedTuple):
    """Constants of steps of one length, [joints, robots] each.

    Attributes:
      time: length [s].
      mean_time: mean time for which a change of the velocity in the step acts [s].
      max_change, min_change: of the acceleration in a step [rad/s^2].
      approach: of a velocity.
    """

    time: np.ndarray
    mean_time: np.ndarray
    max_change: np.ndarray
    min_change: np.ndarray
    approach: _Approach


def _rate(periods: int) -> float:
    """The rate that gives the decay of VELOCITY_RATE over some periods in one step."""
    return (1 - (1 - VELOCITY_RATE * PERIOD) ** periods) / (periods * PERIOD)


def braking_steps(joints: JointParameters) -> int:
    """Steps in which every joint stops from its velocity limit."""
    times = joints.velocity / joints.acceleration + 2 * joints.acceleration / joints.jerk + 5 / VELOCITY_RATE
    return int(np.ceil(float(np.max(times)) / (BRAKE * PERIOD))) + 1
