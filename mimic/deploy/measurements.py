"""Checks of measured states: at the start, and whether a measurement is plausible and within limits in each period."""

import numpy as np

from mimic.control.joint_control import Reference
from mimic.control.limits import JointLimits
from mimic.deploy.config import SafetyConfig

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

    Attributes:
      is_lost: [robots] whether the measurements of an arm can no longer be used.
      any_lost: whether there is such an arm.
    """

    def __init__(self, limits: JointLimits, config: SafetyConfig):
        position, velocity = np.asarray(limits.position, float), np.asarray(limits.velocity, float)
        self._lower, self._upper = position[:, 0] + config.position, position[:, 1] - config.position
        zero = np.zeros_like(velocity)
        # Maxima of the tracking error, the change of the angle, the speed, and how far the angle is beyond its range.
        self._maxima = np.stack([zero + config.tracking, zero + config.jump, config.velocity * velocity, zero, zero])
        self._periods = config.velocity_periods
        self.begin(np.zeros((len(velocity), 0)))

    def begin(self, qpos: np.ndarray) -> None:
        """Begins with measured angles."""
        joints, robots = qpos.shape
        self._previous, self._values = qpos.copy(), np.zeros((5, joints, robots))
        self._ends = np.tile(np.stack([self._upper, self._lower])[..., None], robots)
        self._bounds = np.tile(self._maxima[..., None], robots)
        self._fast, self.is_lost, self.any_lost = np.zeros(robots, int), np.zeros(robots, bool), False

    def __call__(
        self, qpos: np.ndarray, qvel: np.ndarray, reference: Reference, known: np.ndarray
    ) -> tuple[np.ndarray | None, np.ndarray]:
        """The causes of arms that must stop, None if there are none, and tracking errors [joints, robots] [rad]."""
        values, (upper, lower) = self._values, self._ends
        np.subtract(qpos, reference.qpos, out=values[0])
        np.subtract(qpos, self._previous, out=values[1])
        values[2] = qvel
        np.abs(values[:3], out=values[:3])
        np.subtract(qpos, upper, out=values[3])
        np.subtract(lower, qpos, out=values[4])
        np.copyto(self._previous, qpos)  # a driver may use its array again
        is_within = values <= self._bounds  # False for NaN
        if np.count_nonzero(is_within) == is_within.size:
            self._fast[:] = 0
            return None, values[0]
        return self._causes(np.all(is_within, axis=1), known)

    def _causes(self, is_within: np.ndarray, known: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        """See `__call__`, where a value of a robot is not within its bound; [5, robots]."""
        tracks, is_smooth, is_slow, *is_inside = is_within
        is_finite = np.isfinite(self._values.sum(axis=(0, 1)))
        self._fast = (self._fast + 1) * ~is_slow
        self.is_lost |= ~is_finite | ~is_smooth
        self.any_lost = bool(self.is_lost.any())
        is_near, is_fast = ~np.all(is_inside, axis=0), self._fast >= self._periods
        error = np.where(is_finite, self._values[0], 0.0)
        cause = np.select(
            [~is_finite, ~is_smooth, ~tracks, is_near, is_fast],
            [INVALID_STATE, JUMP, TRACKING, POSITION, VELOCITY],
            "",
        )
        return np.where(known == "", cause, "").astype(object), error
