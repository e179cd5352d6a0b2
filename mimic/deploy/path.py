"""Predicts where a reference goes under a target and then brakes: `next_reference` with larger steps, in place."""

from collections.abc import Callable

import numpy as np

from mimic.control.joint_control import APPROACH_RATE, BRAKING_FRACTION, PERIOD, JointParameters, Reference

SAMPLE = 0.01  # s, between two angles of a path; also the step of the prediction while a reference brakes
_LAG = 0.01  # s: time constant of the reference's velocity, as in `next_reference`
_PER_SAMPLE = round(SAMPLE / PERIOD)
_DECAY = (1 - (1 - PERIOD / _LAG) ** _PER_SAMPLE) / SAMPLE  # 1/s, of the velocity in the larger step


class PathPrediction:
    """Paths of many robots' references that follow their present target, hold a new one for a time, and brake to a stop.

    The steps until a reference brakes are those of the inner loop. The larger ones of braking differ from them by less than
    `ERROR`, and take a tenth of the time. A path is computed in parts that fit between two periods.

    Args:
      joints: parameters, [joints, 1] each.
      is_position: whether targets are angles [rad]; otherwise velocities [rad/s].
      delay: periods until the new target acts.
      hold: periods for which it acts, a multiple of 10.
      robots: number of robots.
    """

    ERROR = 0.003  # rad, maximum over the joints

    def __init__(self, joints: JointParameters, is_position: bool, delay: int, hold: int, robots: int = 1):
        self._delay_steps, self._hold_steps = delay, delay + hold
        self.steps = self._hold_steps + braking_steps(joints)
        size = joints.lower.shape[0], robots
        self._path = np.zeros((1 + hold // _PER_SAMPLE + self.steps - self._hold_steps, *size))
        self._qpos, self._qvel, self._qacc, self._speed, self._change, self._swing = np.zeros((6, *size))
        self._room, self._bound, self._far = np.zeros((3, 2, *size))
        self._ends = np.stack([joints.upper, -joints.lower])
        self._sign = np.array([1.0, -1.0])[:, None, None]
        braking = BRAKING_FRACTION * joints.acceleration
        self._slope, self._offset = 2 * braking, braking**2 / APPROACH_RATE**2
        self._velocity, self._is_position = joints.velocity, is_position
        self._swing_time = 1 / (2 * joints.jerk)
        self._most, self._least = joints.acceleration * np.ones(size), -joints.acceleration * np.ones(size)
        self._most_swing, self._least_swing = joints.jerk * PERIOD, -joints.jerk * PERIOD
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
                self._left[:] = self._hold_steps
                self._sample()
            if self._count < self._hold_steps:
                self._hold()
            else:
                self._brake()
            self._count += 1
            since = self._count - self._delay_steps
            if since > 0 and (self._count > self._hold_steps or since % _PER_SAMPLE == 0):
                self._sample()
        return self._count == self.steps

    @property
    def path(self) -> np.ndarray:
        """The angles when the new target begins to act and after each `SAMPLE`, [samples, joints, robots] [rad]."""
        return self._path[: self._samples]

    def parts(self, count: int) -> list[np.ndarray]:
        """The path in parts of about the same length."""
        return np.array_split(self.path, count)

    def _sample(self) -> None:
        self._path[self._samples] = self._qpos
        self._samples += 1

    def _hold(self) -> None:
        """A step as in `next_reference`."""
        if self._is_position:
            error = self._target - self._qpos
            np.multiply(np.sign(error), self._approach(np.abs(error)), out=self._speed)
        else:
            self._speed[:] = self._target
        if self._count < self._delay_steps:
            self._speed *= self._left > self._count
        acceleration = self._limited_change(1 / _LAG)
        swing = np.subtract(acceleration, self._qacc, out=self._swing)
        np.minimum(swing, self._most_swing, out=swing)
        np.maximum(swing, self._least_swing, out=swing)
        self._qacc += swing
        self._move(np.multiply(self._qacc, PERIOD, out=self._change), PERIOD)

    def _brake(self) -> None:
        """A larger step towards rest: the velocity decays exactly, and the jerk limit delays the change."""
        self._speed[:] = 0.0
        acceleration = self._limited_change(_DECAY)
        swing = np.subtract(acceleration, self._qacc, out=self._swing)
        self._qacc[:] = acceleration
        swing *= np.abs(swing)
        swing *= self._swing_time
        change = np.multiply(acceleration, SAMPLE, out=self._change)
        change -= swing
        self._move(change, SAMPLE)

    def _limited_change(self, rate: float) -> np.ndarray:
        """The acceleration towards `speed`, which the joint's ends and its velocity limit bound."""
        speed, room, bound, far = self._speed, self._room, self._bound, self._far
        np.multiply(self._sign, self._qpos, out=room)
        np.subtract(self._ends, room, out=room)
        np.multiply(room, self._slope, out=far)
        far -= self._offset
        np.maximum(far, self._offset, out=far)
        np.sqrt(far, out=far)
        np.multiply(room, APPROACH_RATE, out=bound)
        np.minimum(bound, far, out=bound)
        np.minimum(bound, self._velocity, out=bound)
        np.minimum(speed, bound[0], out=speed)
        np.maximum(speed, np.negative(bound[1], out=bound[1]), out=speed)
        speed -= self._qvel
        speed *= rate
        np.minimum(speed, self._most, out=speed)
        return np.maximum(speed, self._least, out=speed)

    def _move(self, change: np.ndarray, step: float) -> None:
        """Adds a change of the velocity; the angle moves at the mean of the velocities after each period."""
        self._qpos += np.multiply(self._qvel, step, out=self._swing)
        self._qvel += change
        self._qpos += np.multiply(change, 0.5 * (step + PERIOD), out=self._swing)

    def _approach(self, distance: np.ndarray) -> np.ndarray:
        far = np.sqrt(np.maximum(self._slope * distance - self._offset, self._offset))
        return np.minimum(APPROACH_RATE * distance, far)


def braking_steps(joints: JointParameters) -> int:
    """Steps in which every joint stops from its velocity limit."""
    longest = float(np.max(joints.velocity / joints.acceleration))
    return int(np.ceil((longest + 5 * _LAG) / SAMPLE)) + 1
