"""Checks of measured states: at the start, and whether a measurement is plausible and within limits in each period."""

import numpy as np

from mimic.control.limits import JointLimits
from mimic.deploy.config import SafetyConfig
from mimic.deploy.joint_motion import State, joint_numbers

START_POSE, NOT_AT_REST = "start pose", "not at rest"
INVALID_STATE, JUMP, TRACKING = "invalid state", "state jump", "tracking error"
POSITION, VELOCITY = "near position limit", "near velocity limit"


class StartCheck:
    """Finds arms that are not near their start poses and at rest, all arrays [joints, robots]."""

    def __init__(self, limits: JointLimits, config: SafetyConfig):
        self._lower, self._upper = (np.asarray(x, float)[:, None] for x in limits.position.T)
        self._distance, self._speed = config.start_distance, config.start_speed

    def __call__(self, qpos: np.ndarray, qvel: np.ndarray, start_pose: np.ndarray) -> np.ndarray:
        """The cause for each arm, or nothing."""
        within = (qpos > self._lower) & (qpos < self._upper) & (np.abs(qpos - start_pose) <= self._distance)
        is_at_rest = np.abs(qvel) <= self._speed
        cause = np.where(within.all(axis=0), np.where(is_at_rest.all(axis=0), "", NOT_AT_REST), START_POSE)
        is_finite = np.isfinite(qpos).all(axis=0) & np.isfinite(qvel).all(axis=0)
        return np.where(is_finite, cause, INVALID_STATE).astype(object)


class MeasurementCheck:
    """Finds arms whose measured states are implausible or near limits.

    Lists have a number for each joint of each robot, in the order of arrays [joints, robots].

    Attributes:
      is_lost: whether the measurements of the arm can no longer be used.
    """

    def __init__(self, limits: JointLimits, config: SafetyConfig, robots: int):
        self._robots, self._config = robots, config
        lower, upper = limits.position.T
        bounds = lower + config.position, upper - config.position, config.velocity * np.asarray(limits.velocity)
        self._bounds = joint_numbers(np.repeat(x, robots) for x in bounds)
        self._largest_errors = [0.0] * len(self._bounds)
        self._is_tracked = [True] * len(self._bounds)
        self.begin([0.0] * len(self._bounds))

    @property
    def tracking_error(self) -> np.ndarray:
        """The largest tracking error [robots] [rad]."""
        return np.array(self._largest_errors).reshape(-1, self._robots).max(axis=0)

    def begin(self, qpos: list[float]) -> None:
        """Begins with measured angles."""
        self._previous = qpos
        self._fast, self.is_lost = np.zeros(self._robots, int), [False] * len(qpos)

    def release(self, robots: np.ndarray) -> None:
        """No longer notes the tracking errors of some robots [robots]."""
        self._is_tracked = (np.reshape(self._is_tracked, (-1, self._robots)) & ~robots).ravel().tolist()

    def __call__(self, qpos: list[float], qvel: list[float], states: list[State]) -> np.ndarray | None:
        """Why arms must stop [robots], empty for the others; None if all measurements are within their bounds.

        Args:
          qpos, qvel: measured [rad, rad/s].
          states: references at the same time.
        """
        tracking, jump, largest = self._config.tracking, self._config.jump, self._largest_errors
        previous, self._previous, are_within = self._previous, qpos, True
        for i, (angle, speed, before, state, (lower, upper, fastest)) in enumerate(
            zip(qpos, qvel, previous, states, self._bounds, strict=True)
        ):
            error = angle - state[0]
            if error < 0:
                error = -error
            is_within = -jump <= angle - before <= jump and -fastest <= speed <= fastest and lower <= angle <= upper
            if not (is_within and error <= tracking):  # neither for NaN
                are_within = False
            elif error > largest[i] and self._is_tracked[i]:
                largest[i] = error
        if are_within:
            self._fast[:] = 0
            return None
        reference = [state[0] for state in states]
        return self._causes(np.reshape([qpos, qvel, previous, reference], (4, -1, self._robots)))

    def _causes(self, measured: np.ndarray) -> np.ndarray:
        """See `__call__`, where a value of a robot is not within its bound.

        Args:
          measured: angles, velocities, the angles before and the reference's [4, joints, robots].
        """
        qpos, qvel, previous, reference = measured
        lower, upper, fastest = np.array(self._bounds).T.reshape(3, *qpos.shape)
        error = np.abs(qpos - reference)
        is_finite = np.isfinite(error + qvel).all(axis=0)
        is_smooth = (np.abs(qpos - previous) <= self._config.jump).all(axis=0)
        self._fast = np.where((np.abs(qvel) <= fastest).all(axis=0), 0, self._fast + 1)
        is_noted = np.reshape(self._is_tracked, qpos.shape) & is_finite
        largest = np.reshape(self._largest_errors, qpos.shape)
        self._largest_errors = np.where(is_noted, np.maximum(largest, error), largest).ravel().tolist()
        self.is_lost = (np.reshape(self.is_lost, qpos.shape) | ~is_finite | ~is_smooth).ravel().tolist()
        causes = np.select(
            [
                ~is_finite,
                ~is_smooth,
                ~(error <= self._config.tracking).all(axis=0),
                ~((lower <= qpos) & (qpos <= upper)).all(axis=0),
                self._fast >= self._config.velocity_periods,
            ],
            [INVALID_STATE, JUMP, TRACKING, POSITION, VELOCITY],
            "",
        )
        return causes.astype(object)
