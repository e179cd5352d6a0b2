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
    """

    def __init__(self, limits: JointLimits, config: SafetyConfig):
        position, velocity = np.asarray(limits.position, float), np.asarray(limits.velocity, float)
        self._lower, self._upper = position[:, :1] + config.position, position[:, 1:] - config.position
        self._velocity, self._periods = config.velocity * velocity[:, None], config.velocity_periods
        self._jump, self._tracking = config.jump, config.tracking
        self._previous, self._fast = np.zeros((0, 0)), np.zeros(0, int)
        self.is_lost = np.zeros(0, bool)

    def begin(self, qpos: np.ndarray) -> None:
        """Begins with measured angles."""
        self._previous = qpos.copy()
        self._fast, self.is_lost = np.zeros(qpos.shape[1], int), np.zeros(qpos.shape[1], bool)

    def __call__(
        self, qpos: np.ndarray, qvel: np.ndarray, reference: Reference, known: np.ndarray
    ) -> tuple[np.ndarray | None, np.ndarray]:
        """The causes of arms that must stop, None if there are none, and the tracking errors [robots] [rad]."""
        error = np.abs(qpos - reference.qpos).max(axis=0)
        moved = np.abs(qpos - self._previous).max(axis=0)
        self._previous = qpos
        is_fast = (np.abs(qvel) > self._velocity).any(axis=0)
        self._fast = (self._fast + 1) * is_fast
        is_near = ((qpos < self._lower) | (qpos > self._upper)).any(axis=0)
        # Sums of NaN are NaN, and comparisons with it are False.
        is_fine = (error <= self._tracking) & (moved <= self._jump) & (self._fast < self._periods) & ~is_near
        is_finite = np.isfinite(qvel.sum(axis=0) + moved)
        if (is_fine & is_finite).all():
            return None, error
        is_implausible = ~is_finite | ~(moved <= self._jump)
        self.is_lost |= is_implausible
        cause = np.select(
            [~is_finite, ~(moved <= self._jump), error > self._tracking, is_near, self._fast >= self._periods],
            [INVALID_STATE, JUMP, TRACKING, POSITION, VELOCITY],
            "",
        )
        return np.where(known == "", cause, "").astype(object), np.where(is_finite, error, 0.0)
