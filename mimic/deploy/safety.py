"""The safety layer: it accepts a policy's target only if the arm can stop after it.

Each accepted target comes with a path that was checked: the target acts for a tick, then the reference brakes. A target
that is rejected or missing changes nothing: the arm then brakes along the path that was checked. All arrays are
[joints, robots]: a robot alone and many in simulation run the same code.
"""

from collections.abc import Callable

import numpy as np

from mimic.control.joint_control import PERIOD, JointParameters, Reference, action_target
from mimic.deploy.bundle import Bundle
from mimic.deploy.config import SafetyConfig
from mimic.deploy.driver import Command
from mimic.deploy.path import STEP, PathGenerator, extended

# Interventions, which replace a target, and the causes for which an arm stops for good.
COLLISION, INVALID, REPEATED, LATE = "clearance", "invalid action", "repeated action", "late policy"
INTERVENTIONS = (COLLISION, INVALID, REPEATED, LATE)
START_POSE, NOT_AT_REST, START_CLEARANCE = "start pose", "not at rest", "start clearance"
INVALID_STATE, TRACKING, POSITION = "invalid state", "tracking error", "near position limit"
MEASURED_CLEARANCE = "measured clearance"
_ACTION_TOLERANCE = 1e-3  # beyond [-1, 1]: float32 rounds a saturated tanh


def check_supported(control: str, control_dt: float, config: SafetyConfig | None = None) -> None:
    """Checks that the safety layer can check the targets of a policy.

    Args:
      control: mode of the inner loop, see `mimic.control`.
      control_dt: tick of the policy [s].
      config: thresholds; default: `SafetyConfig()`.

    Raises:
      ValueError: the mode has no braking path, or the tick does not have whole steps or not time for the check.
    """
    config = config or SafetyConfig()
    if control == "torque":
        raise ValueError(
            "mode: expected joint_position or joint_velocity, whose targets have a braking path, got torque"
        )
    step = STEP * PERIOD
    are_whole = all(abs(time / step - round(time / step)) < 1e-6 for time in (control_dt, config.latency))
    if not are_whole or round(control_dt / step) <= round(config.latency / step):
        raise ValueError(
            f"control_dt, latency: expected multiples of {step} s and a tick above the latency, got {control_dt} s and "
            f"{config.latency} s"
        )


class SafetyLayer:
    """Turns the actions of a policy into commands for some robots with the same controller, once in a tick.

    Args:
      bundle: the controller.
      robots: number of robots.
      config: thresholds.
      clearance: gives the clearance [rows] [m] of poses [rows, joints]; that of the bundle where None.

    Attributes:
      cause: [robots] why the arm was stopped for good; empty while it is controlled.
      counts: [robots] number of interventions, by kind.
      tracking_error: [robots] largest difference between a measured angle and the reference [rad].
      clearance: [robots] smallest clearance of a measured pose [m].
      brake_ticks: ticks in which an arm comes to rest from any motion.
    """

    def __init__(
        self,
        bundle: Bundle,
        robots: int = 1,
        config: SafetyConfig | None = None,
        clearance: Callable[[np.ndarray], np.ndarray] | None = None,
    ):
        self._config, self._mode = config or SafetyConfig(), bundle.mode
        self._clearance = clearance or bundle.clearance_of
        check_supported(bundle.mode, bundle.control_dt, self._config)
        self._joints = JointParameters(*(np.tile(np.asarray(x, float)[:, None], robots) for x in bundle.parameters))
        scaled = self._joints._replace(
            velocity=self._config.velocity_scale * self._joints.velocity,
            acceleration=self._config.acceleration_scale * self._joints.acceleration,
        )
        self._paths = PathGenerator(bundle.mode, scaled, bundle.periods)
        self._hold = self._paths.hold_steps
        self._now = self._hold - round(self._config.latency / (STEP * PERIOD))  # steps of the path at a measurement
        self.brake_ticks = -(-self._paths.brake_steps // self._hold)
        self._range = bundle.limits.position[:, 0, None], bundle.limits.position[:, 1, None]
        self._size = bundle.num_joints, robots
        self._path = np.zeros((3, self._hold + self._paths.brake_steps, *self._size))  # since the last command
        self._action, self._repeats = np.zeros(self._size), np.zeros(robots, int)
        self._has_action = np.zeros(robots, bool)
        self.cause = np.full(robots, "", object)
        self.counts = {name: np.zeros(robots, int) for name in INTERVENTIONS}
        self.tracking_error, self.clearance = np.zeros(robots), np.full(robots, np.inf)

    def start(self, qpos: np.ndarray, qvel: np.ndarray, start_pose: np.ndarray) -> np.ndarray:
        """Begins to control arms that are near their start poses and at rest; gives the cause for those that are not.

        Args:
          qpos, qvel: measured [rad, rad/s].
          start_pose: [joints, robots] [rad].
        """
        lower, upper = self._range
        is_near = (qpos > lower) & (qpos < upper) & (np.abs(qpos - start_pose) <= self._config.start_distance)
        is_at_rest = np.abs(qvel) <= self._config.start_speed
        is_clear = self._clearance(np.nan_to_num(qpos).T) >= self._config.margin - self._config.creep
        is_finite = np.isfinite(qpos) & np.isfinite(qvel)
        failed = [~is_finite.all(axis=0), ~is_near.all(axis=0), ~is_at_rest.all(axis=0), ~is_clear]
        self.cause = np.select(failed, [INVALID_STATE, START_POSE, NOT_AT_REST, START_CLEARANCE], "").astype(object)
        self._path[:] = 0
        self._path[0] = np.where(is_finite.all(axis=0), qpos, start_pose)
        return self.cause

    @property
    def reference(self) -> Reference:
        """The motion that the arms track when the states of a tick are measured, [joints, robots] each."""
        return Reference(*self._path[:, self._now - 1])

    def tick(
        self, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray | None, is_present: np.ndarray | None = None
    ) -> Command:
        """The command that follows the last one when that has ended, `latency` after the measurement.

        Args:
          qpos, qvel: measured [rad, rad/s].
          action: [joints, robots] in [-1, 1]; None makes all arms brake.
          is_present: [robots] whether a new action has arrived; otherwise the last one is used again. Default: all.
        """
        self._check_measured(qpos, qvel)
        begin, rest = Reference(*self._path[:, self._hold - 1]), self._rest()
        self._path = rest
        is_candidate = np.zeros(self._size[1], bool) if action is None else self._candidates(action, is_present)
        if np.any(is_candidate):
            target = action_target(self._mode, self._action, begin, self._joints, np)
            path = self._paths.target_path(begin, target)
            is_safe = self._is_safe(np.concatenate([begin.qpos[None], path[0]]))
            self.counts[COLLISION] += is_candidate & ~is_safe
            self._path = np.where(is_candidate & is_safe, extended(path, rest.shape[1]), rest)
        return Command(Reference(*self._path[:, : self._hold]), self._path[0, -1])

    def skip(self) -> None:
        """Counts a tick that has passed without a command: the arms have begun to brake by themselves."""
        self.counts[LATE] += self.cause == ""
        self._path = self._rest()

    def stop(self, cause: str) -> None:
        """Makes all arms that are controlled brake and hold, for good."""
        self.cause[self.cause == ""] = cause

    def release(self, robots: np.ndarray, cause: str) -> None:
        """No longer controls some arms [robots]: their robots stopped by themselves."""
        self.cause[robots] = cause

    def _rest(self) -> np.ndarray:
        """The path after the end of the last command: the arms brake."""
        return extended(self._path[:, self._hold :], self._path.shape[1])

    def _check_measured(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Stops arms whose measurement is not plausible or too near to something, see `tick`."""
        is_controlled = self.cause == ""
        is_finite = (np.isfinite(qpos) & np.isfinite(qvel)).all(axis=0)
        error = np.where(is_finite, np.abs(qpos - self.reference.qpos).max(axis=0), 0.0)
        clearance = np.where(is_finite, self._clearance(np.nan_to_num(qpos).T), np.inf)
        self.tracking_error = np.where(is_controlled, np.maximum(self.tracking_error, error), self.tracking_error)
        self.clearance = np.where(is_controlled, np.minimum(self.clearance, clearance), self.clearance)
        lower, upper = self._range
        near = self._config.position
        is_inside = ((qpos >= lower + near) & (qpos <= upper - near)).all(axis=0)
        failed = [~is_finite, error > self._config.tracking, ~is_inside, ~(clearance >= self._config.measured_margin)]
        cause = np.select(failed, [INVALID_STATE, TRACKING, POSITION, MEASURED_CLEARANCE], "").astype(object)
        self.cause = np.where(is_controlled, cause, self.cause)
        is_blocked = is_controlled & (cause == TRACKING)
        if np.any(is_blocked):  # brakes from the measured motion: the reference would push the arm on
            self._path = np.where(is_blocked, self._measured_path(qpos, qvel), self._path)

    def _measured_path(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """The path on which arms brake from their measured motion, as if it had been commanded a tick ago."""
        bound = self._joints.velocity
        measured = Reference(np.nan_to_num(qpos), np.clip(np.nan_to_num(qvel), -bound, bound), np.zeros(self._size))
        before = np.repeat(np.stack(measured)[:, None], self._hold, axis=1)
        path = np.concatenate([before, self._paths.braking_path(measured)], axis=1)
        return extended(path, self._path.shape[1])

    def _candidates(self, action: np.ndarray, is_present: np.ndarray | None) -> np.ndarray:
        """Whether there is an action [robots], which is then noted; counts those that are not used."""
        is_active = self.cause == ""
        is_present = np.ones(self._size[1], bool) if is_present is None else is_present
        is_valid = np.all(np.abs(action) <= 1 + _ACTION_TOLERANCE, axis=0)  # False for NaN
        is_new = is_present & is_valid
        self._action = np.where(is_new, action, self._action)
        self._has_action |= is_new
        self._repeats = np.where(is_present, 0, self._repeats + 1)
        is_missing = is_active & ~is_present & self._has_action
        is_repeated = is_missing & (self._repeats <= self._config.repeats)
        self.counts[INVALID] += is_active & is_present & ~is_valid
        self.counts[REPEATED] += is_repeated
        self.counts[LATE] += is_missing & ~is_repeated
        return is_active & is_new | is_repeated

    def _is_safe(self, qpos: np.ndarray) -> np.ndarray:
        """Whether the clearance along paths [samples, joints, robots] is above the margin, or no less than at first.

        A path from within the margin may not come nearer, and none may come nearer than margin - creep.
        """
        samples, joints, robots = qpos.shape
        clearance = self._clearance(qpos.transpose(0, 2, 1).reshape(-1, joints)).reshape(samples, robots)
        floor = self._config.margin - self._config.creep
        required = np.minimum(self._config.margin, np.maximum(clearance[0], floor))
        return np.all(clearance[1:] >= required, axis=0)  # False for NaN
