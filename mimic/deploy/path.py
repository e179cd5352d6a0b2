"""Predicts where a reference goes under a target and then brakes: `next_reference` with larger steps.

It computes with Python's numbers, one joint at a time: for the few joints of one arm that takes less than half of the
time of operations on arrays. For many robots it takes more.
"""

from collections.abc import Callable, Iterable
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
      samples: number of its angles.
    """

    ERROR = 0.008  # rad, maximum over the joints

    def __init__(self, joints: JointParameters, is_position: bool, delay: int, hold: int, robots: int = 1):
        self._delay_steps, self._hold_steps = delay // HOLD, (delay + hold) // HOLD
        brake_steps = braking_steps(joints)
        self.steps = self._hold_steps + brake_steps
        self.samples = 1 + hold // SAMPLE + brake_steps * _PER_BRAKE
        self._size = joints.lower.shape[0], robots
        full = (np.broadcast_to(x, self._size) for x in joints)
        self._joints = [_joint(JointParameters(*numbers)) for numbers in _numbers(full)]
        self._is_position = is_position
        self._path = np.zeros((self.samples, *self._size))
        self._states: list[_State] = []
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
        self._states = _numbers(reference)
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
            reference = Reference(*np.array(self._states).T.reshape(3, *self._size))
            self._targets = new_target(reference).ravel().tolist()
            self._path[0], self._samples = reference.qpos, 1
        if self._delay_steps <= self._count < min(end, self._hold_steps):
            self._hold(min(end, self._hold_steps))
        if self._hold_steps <= self._count < end:
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
            state, _ = _moved(self._states[i], held, joint, HOLD, target, is_position=self._is_position)
            self._states[i], _ = _moved(state, count - held, joint, HOLD, None)
        self._count = end

    def _hold(self, end: int) -> None:
        """Steps with the new target, and a sample after each `_PER_SAMPLE` of them."""
        angles, count = [], end - self._count
        for i, (joint, target) in enumerate(zip(self._joints, self._targets, strict=True)):
            state, reached = _moved(self._states[i], count, joint, HOLD, target, is_position=self._is_position)
            self._states[i] = state
            angles.append(reached)
        skipped = -(self._count - self._delay_steps + 1) % _PER_SAMPLE
        self._count = end
        self._add([x[skipped::_PER_SAMPLE] for x in angles])

    def _brake(self, end: int) -> None:
        """Steps of braking, and the samples between their ends."""
        angles, count = [], end - self._count
        for i, joint in enumerate(self._joints):
            self._states[i], reached = _moved(self._states[i], count, joint, BRAKE, None)
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


_State = tuple[float, float, float]  # angle, velocity and acceleration of a reference


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


class _Joint(NamedTuple):
    """Constants of a joint: see `ReferenceLimits`; `approach` of an angle, and of the steps of each length."""

    lower: float
    upper: float
    velocity: float
    acceleration: float
    reaction: float
    approach: Approach
    steps: dict[int, _Step]


def _joint(joint: JointParameters) -> _Joint:
    """The constants of a joint from its parameters, numbers."""
    return _Joint(
        joint.lower,
        joint.upper,
        joint.velocity,
        joint.acceleration,
        REACTION_FRACTION * joint.acceleration / joint.jerk,
        approach(BRAKING_FRACTION * joint.acceleration, APPROACH_RATE),
        {
            periods: _Step(
                periods * PERIOD,
                0.5 * (periods * PERIOD + PERIOD),
                joint.jerk * periods * PERIOD,
                1 / (2 * joint.jerk),
                approach(BRAKING_FRACTION * joint.jerk, _rate(periods)),
            )
            for periods in (HOLD, BRAKE)
        },
    )


def _rate(periods: int) -> float:
    """The rate that gives the decay of VELOCITY_RATE over some periods in one step."""
    return (1 - (1 - VELOCITY_RATE * PERIOD) ** periods) / (periods * PERIOD)


def _numbers(arrays: Iterable[np.ndarray]) -> list[Any]:
    """A tuple of the numbers of some arrays [joints, robots] for each joint of each robot."""
    return list(zip(*(x.ravel().tolist() for x in arrays), strict=True))


def _moved(
    state: _State, count: int, joint: _Joint, periods: int, target: float | None, *, is_position: bool = False
) -> tuple[_State, list[float]]:
    """Some steps of a reference as in `next_reference`, and its angle after each of them.

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


def _interpolated(before: float, ends: list[float]) -> list[float]:
    """The samples of steps of braking that end at some angles."""
    samples = []
    for end in ends:
        samples += [before + k / _PER_BRAKE * (end - before) for k in range(1, _PER_BRAKE)]
        samples.append(end)
        before = end
    return samples
