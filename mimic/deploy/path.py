"""Predicts where a reference goes under a target and then brakes: `next_reference` with larger steps, in place."""

from collections.abc import Callable

import numpy as np

from mimic.control.joint_control import (
    APPROACH_RATE,
    BRAKING_FRACTION,
    PERIOD,
    REACTION_FRACTION,
    VELOCITY_RATE,
    JointParameters,
    Reference,
)

HOLD, BRAKE = 2, 20  # periods of a step, while targets act and while the references brake
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
    """

    ERROR = 0.008  # rad, maximum over the joints

    def __init__(self, joints: JointParameters, is_position: bool, delay: int, hold: int, robots: int = 1):
        self._delay_steps, self._hold_steps = delay // HOLD, (delay + hold) // HOLD
        self._brake_steps = braking_steps(joints)
        self.steps = self._hold_steps + self._brake_steps
        size = joints.lower.shape[0], robots
        self._path = np.zeros((1 + hold // SAMPLE + self._brake_steps * _PER_BRAKE, *size))
        self._qpos, self._qvel, self._qacc, self._speed, self._a, self._b = np.zeros((6, *size))
        self._room, self._bound, self._far = np.zeros((3, 2, *size))
        self._is_position, self._joints = is_position, joints
        self._ends = np.stack([joints.upper, -joints.lower])
        self._sign = np.array([1.0, -1.0])[:, None, None]
        self._reaction = REACTION_FRACTION * joints.acceleration / joints.jerk
        self._position = _Approach(BRAKING_FRACTION * joints.acceleration, APPROACH_RATE)
        self._velocity = {n: _Approach(BRAKING_FRACTION * joints.jerk, _rate(n)) for n in (HOLD, BRAKE)}
        self._swing_time = 1 / (2 * joints.jerk)
        self._most, self._least = joints.acceleration, -joints.acceleration
        self._target, self._left = np.zeros(size), np.zeros(robots, int)
        self._count, self._samples = self.steps, 0

    def begin(self, reference: Reference, target: np.ndarray, left: np.ndarray) -> None:
        """Starts the paths.

        Args:
          reference: at present, [joints, robots] each.
          target: that acts at present, [joints, robots].
          left: [robots] periods until its references brake.
        """
        self._qpos[:], self._qvel[:], self._qacc[:] = reference
        self._target, self._left, self._count, self._samples = target, left.copy(), 0, 0

    def advance(self, steps: int, new_target: Callable[[Reference], np.ndarray]) -> bool:
        """Computes some more steps; returns whether the paths are complete.

        Args:
          steps: number of them.
          new_target: gives the new target, [joints, robots], for the reference at the time when it begins to act.
        """
        for _ in range(min(steps, self.steps - self._count)):
            if self._count == self._delay_steps:
                self._target = new_target(Reference(self._qpos, self._qvel, self._qacc))
                self._sample()
            is_braking = self._count >= self._hold_steps
            if is_braking:
                self._speed[:] = 0.0
            else:
                self._follow()
            self._step(BRAKE if is_braking else HOLD)
            self._count += 1
            since = HOLD * (self._count - self._delay_steps)
            if is_braking:
                self._sample(_PER_BRAKE)
            elif since > 0 and since % SAMPLE == 0:
                self._sample()
        return self._count == self.steps

    @property
    def path(self) -> np.ndarray:
        """The angles when the new target begins to act and after each `SAMPLE`, [samples, joints, robots] [rad]."""
        return self._path[: self._samples]

    def parts(self, count: int) -> list[np.ndarray]:
        """The path in parts of about the same length."""
        return np.array_split(self.path, count)

    def _sample(self, count: int = 1) -> None:
        """Adds the present angles to the path, and before them some that are interpolated."""
        last = self._samples + count - 1
        self._path[last] = self._qpos
        for k in range(1, count):
            before = self._path[self._samples - 1]
            self._path[self._samples + k - 1] = before + k / count * (self._qpos - before)
        self._samples = last + 1

    def _follow(self) -> None:
        """The speed for the target that acts, and for those that no longer act, 0."""
        if self._is_position:
            error = self._target - self._qpos - self._reaction * self._qvel
            np.copysign(self._position(np.abs(error)), error, out=self._speed)
        else:
            self._speed[:] = self._target
        if self._count < self._delay_steps:
            self._speed *= self._left > HOLD * self._count

    def _step(self, periods: int) -> None:
        """A step as in `next_reference`, towards `speed`."""
        step, a, b = periods * PERIOD, self._a, self._b
        change = self._bounded_speed()
        change -= self._qvel
        swing = self._velocity[periods](np.abs(change, out=a))
        np.copysign(swing, change, out=swing)
        np.minimum(swing, self._most, out=swing)
        np.maximum(swing, self._least, out=swing)
        swing -= self._qacc
        most = self._joints.jerk * step
        np.minimum(swing, most, out=swing)
        np.maximum(swing, -most, out=swing)
        self._qacc += swing
        np.multiply(self._qacc, step, out=a)
        np.multiply(np.abs(swing, out=b), swing, out=b)  # the jerk limit delays a part of the change
        b *= self._swing_time
        a -= b
        # The angle moves at the mean of the velocities after each period.
        self._qpos += np.multiply(self._qvel, step, out=b)
        self._qpos += np.multiply(a, 0.5 * (step + PERIOD), out=b)
        self._qvel += a

    def _bounded_speed(self) -> np.ndarray:
        """The speed within the velocity limit, and so that the joint stops before its ends."""
        speed, room, bound = self._speed, self._room, self._bound
        np.multiply(self._reaction, self._qvel, out=self._a)
        self._a += self._qpos
        np.multiply(self._sign, self._a, out=room)
        np.subtract(self._ends, room, out=room)
        bound[:] = np.minimum(self._position(room), self._joints.velocity)
        np.minimum(speed, bound[0], out=speed)
        return np.maximum(speed, np.negative(bound[1], out=bound[1]), out=speed)


class _Approach:
    """`approach_speed` with its constants; its two pieces are the minimum of a line and of a root."""

    def __init__(self, acceleration: np.ndarray, rate: float):
        self._slope, self._offset, self._rate = 2 * acceleration, acceleration**2 / rate**2, rate

    def __call__(self, distance: np.ndarray) -> np.ndarray:
        far = distance * self._slope
        far -= self._offset
        np.maximum(far, self._offset, out=far)
        np.sqrt(far, out=far)
        return np.minimum(far, distance * self._rate, out=far)


def _rate(periods: int) -> float:
    """The rate that gives the decay of VELOCITY_RATE over some periods in one step."""
    return (1 - (1 - VELOCITY_RATE * PERIOD) ** periods) / (periods * PERIOD)


def braking_steps(joints: JointParameters) -> int:
    """Steps in which every joint stops from its velocity limit."""
    times = joints.velocity / joints.acceleration + 2 * joints.acceleration / joints.jerk + 5 / VELOCITY_RATE
    return int(np.ceil(float(np.max(times)) / (BRAKE * PERIOD))) + 1
