"""Predicts where a reference goes under a target and then brakes: `next_reference` with larger steps.

It computes with Python's numbers, one joint at a time, see `mimic.deploy.joint_motion`.
"""

from collections.abc import Callable

import numpy as np

from mimic.control.joint_control import PERIOD, VELOCITY_RATE, JointParameters, Reference
from mimic.deploy.joint_motion import State, joint_motion, joint_numbers, joint_reference, moved

HOLD, BRAKE = 2, 30  # periods of a step, while targets act and while the references brake
SAMPLE = 10  # periods between two angles of a path; those in the middle of a step of braking are interpolated
_PER_SAMPLE, _PER_BRAKE = SAMPLE // HOLD, BRAKE // SAMPLE


class PathPrediction:
    """Paths of robots' references that follow their present target, hold a new one for a time, and brake to a stop.

    Its steps are larger than those of the inner loop; the angles differ by less than `ERROR`. A path is computed in
    parts that fit between two periods.

    Args:
      joints: parameters, [joints, robots] or [joints, 1] each.
      is_position: whether targets are angles [rad]; otherwise velocities [rad/s].
      delay: periods until the new target acts, a multiple of `HOLD`.
      hold: periods for which it acts, a multiple of `SAMPLE`.
      robots: number of robots.

    Attributes:
      steps: number of steps of a path.
      hold_steps: those of them before the reference brakes.
      samples: number of its angles.
    """

    ERROR = 0.008  # rad, maximum over the joints

    def __init__(self, joints: JointParameters, is_position: bool, delay: int, hold: int, robots: int = 1):
        self._delay_steps, self.hold_steps = delay // HOLD, (delay + hold) // HOLD
        brake_steps = braking_steps(joints)
        self.steps = self.hold_steps + brake_steps
        self.samples = 1 + hold // SAMPLE + brake_steps * _PER_BRAKE
        self._size = joints.lower.shape[0], robots
        full = (np.broadcast_to(x, self._size) for x in joints)
        self._joints = [joint_motion(JointParameters(*numbers), HOLD, BRAKE) for numbers in joint_numbers(full)]
        self._is_position = is_position
        self._path = np.zeros((self.samples, *self._size))
        self._states: list[State] = []
        self._targets: list[float] = []
        self._left: list[int] = []
        self._count, self._samples = self.steps, 0

    def begin(self, reference: Reference, target: np.ndarray, left: np.ndarray) -> None:
        """Starts the paths.

        Args:
          reference: at present, [joints, robots] each.
          target: that acts at present, [joints, robots].
          left: [robots] periods until its references brake.
        """
        self._states = joint_numbers(reference)
        self._targets = target.ravel().tolist()
        self._left = np.tile(left, self._size[0]).tolist()
        self._count, self._samples = 0, 0

    def advance(self, steps: int, new_target: Callable[[Reference], np.ndarray]) -> bool:
        """Computes some more steps; returns whether the paths are complete.

        Args:
          steps: number of them.
          new_target: gives the new target, [joints, robots], for the reference at the time when it begins to act.
        """
        end = min(self._count + steps, self.steps)
        if self._count < self._delay_steps:
            self._delay(min(end, self._delay_steps))
        if self._count == self._delay_steps < end:
            reference = joint_reference(self._states, self._size)
            self._targets = new_target(reference).ravel().tolist()
            self._path[0], self._samples = reference.qpos, 1
        if self._delay_steps <= self._count < min(end, self.hold_steps):
            self._hold(min(end, self.hold_steps))
        if self.hold_steps <= self._count < end:
            self._brake(end)
        return self._count == self.steps

    @property
    def path(self) -> np.ndarray:
        """The angles when the new target begins to act and after each `SAMPLE`, [samples, joints, robots] [rad]."""
        return self._path[: self._samples]

    def _delay(self, end: int) -> None:
        """Steps with the present target, until it acts no more: then joints stop."""
        first, count = self._count, end - self._count
        for i, (joint, target, left) in enumerate(zip(self._joints, self._targets, self._left, strict=True)):
            held = min(max(-(-left // HOLD) - first, 0), count)
            state, _ = moved(self._states[i], held, joint, HOLD, target, is_position=self._is_position)
            self._states[i], _ = moved(state, count - held, joint, HOLD, None)
        self._count = end

    def _hold(self, end: int) -> None:
        """Steps with the new target, and a sample after each `_PER_SAMPLE` of them."""
        angles, count = [], end - self._count
        for i, (joint, target) in enumerate(zip(self._joints, self._targets, strict=True)):
            state, reached = moved(self._states[i], count, joint, HOLD, target, is_position=self._is_position)
            self._states[i] = state
            angles.append(reached)
        skipped = -(self._count - self._delay_steps + 1) % _PER_SAMPLE
        self._count = end
        self._add([x[skipped::_PER_SAMPLE] for x in angles])

    def _brake(self, end: int) -> None:
        """Steps of braking, and the samples between their ends."""
        angles, count = [], end - self._count
        for i, joint in enumerate(self._joints):
            self._states[i], reached = moved(self._states[i], count, joint, BRAKE, None)
            angles.append(reached)
        before = self._path[self._samples - 1].ravel().tolist()
        self._count = end
        self._add([_interpolated(x, y) for x, y in zip(before, angles, strict=True)])

    def _add(self, angles: list[list[float]]) -> None:
        """Adds samples, a list of the same length for each joint."""
        first, self._samples = self._samples, self._samples + len(angles[0])
        if first < self._samples:
            self._path[first : self._samples] = np.array(angles).T.reshape(-1, *self._size)


def braking_steps(joints: JointParameters) -> int:
    """Steps in which every joint stops from its velocity limit."""
    times = joints.velocity / joints.acceleration + 2 * joints.acceleration / joints.jerk + 5 / VELOCITY_RATE
    return int(np.ceil(float(np.max(times)) / (BRAKE * PERIOD))) + 1


def _interpolated(before: float, ends: list[float]) -> list[float]:
    """The samples of steps of braking that end at some angles."""
    samples = []
    for end in ends:
        samples += [before + k / _PER_BRAKE * (end - before) for k in range(1, _PER_BRAKE)]
        samples.append(end)
        before = end
    return samples
