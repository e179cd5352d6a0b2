"""The safety layer: the inner loop of some robots at 1 kHz, which accepts a target only if it can stop after it.

Each accepted target comes with a path that was checked: the target acts for a tick and a grace time, then the reference
brakes. A target that is rejected, late or missing changes nothing: the arm then brakes along the path that was checked.
All arrays are [joints, robots]: a robot alone and thousands in simulation run the same code.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from mimic.control.joint_control import (
    PERIOD,
    JointParameters,
    Reference,
    Target,
    action_target,
    joint_torque,
    next_reference,
    reference_limits,
)
from mimic.deploy.bundle import Bundle
from mimic.deploy.config import SafetyConfig
from mimic.deploy.measurements import TRACKING, MeasurementCheck, StartCheck
from mimic.deploy.path import SAMPLE, PathPrediction

# Interventions, which replace a target, and the causes for which an arm stops for good.
COLLISION, INVALID, REPEATED, LATE = "clearance", "invalid action", "repeated action", "late policy"
INTERVENTIONS = (COLLISION, INVALID, REPEATED, LATE)
MEASURED_CLEARANCE = "measured clearance"
_SLOWING = 3.0  # of the damping of the inner loop
_ACTION_TOLERANCE = 1e-3  # beyond [-1, 1]: float32 rounds a saturated tanh


def check_supported(control: str, control_dt: float, config: SafetyConfig | None = None) -> None:
    """Checks that the safety layer can check the targets of a policy.

    Args:
      control: mode of the inner loop, see `mimic.control`.
      control_dt: tick of the policy [s].
      config: thresholds; default: `SafetyConfig()`.

    Raises:
      ValueError: the mode has no braking path, or the check of a target does not fit the tick.
    """
    config = config or SafetyConfig()
    if control == "torque":
        raise ValueError(
            "mode: expected joint_position, joint_velocity or joint_impedance, whose targets have a braking path, "
            "got torque"
        )
    if round(control_dt / PERIOD) <= config.check_periods or _hold_periods(control_dt, config) % SAMPLE:
        raise ValueError(
            f"control_dt, grace: expected a tick of more than {config.check_periods} ms, and a multiple of {SAMPLE} ms "
            f"together, got {control_dt} s and {config.grace} s"
        )


def _hold_periods(control_dt: float, config: SafetyConfig) -> int:
    """Periods for which a target acts."""
    return round(control_dt / PERIOD) + round(config.grace / PERIOD)


class SafetyLayer:
    """The inner loops of some robots with the same controller.

    In each period: `period` gives the torques, `tick` takes the policy's actions where they have arrived, and `work`
    computes in the rest of the period.

    Args:
      bundle: the controller.
      clearance: gives the clearance [rows] [m] of poses [rows, joints].
      robots: number of robots.
      config: thresholds.

    Attributes:
      reference: the motion that the arms track.
      torque: of the last period [N m].
      cause: [robots] why the arm was stopped for good; empty while it is controlled.
      has_action: [robots] whether a valid action has ever arrived.
      counts: [robots] number of interventions, by kind.
      clearance: [robots] smallest clearance of a measured pose [m], of nearly every period.
    """

    def __init__(
        self,
        bundle: Bundle,
        clearance: Callable[[np.ndarray], np.ndarray],
        robots: int = 1,
        config: SafetyConfig | None = None,
    ):
        config = config or SafetyConfig()
        check_supported(bundle.mode, bundle.control_dt, config)
        hold = _hold_periods(bundle.control_dt, config)
        self._mode, self._config, self._clearance, self._hold = bundle.mode, config, clearance, hold
        # As large as the states: NumPy takes twice as long to broadcast.
        self._actions = JointParameters(*(np.tile(np.asarray(x, float)[:, None], robots) for x in bundle.parameters))
        self._joints = self._actions._replace(
            velocity=config.velocity_scale * self._actions.velocity,
            acceleration=config.acceleration_scale * self._actions.acceleration,
        )
        self._limits = reference_limits(self._joints)
        self._slow = config.slow_down * np.tile(np.asarray(bundle.limits.velocity, float)[:, None], robots)
        is_position = bundle.mode != "joint_velocity"
        self._path = PathPrediction(self._joints, is_position, config.check_periods, hold, robots)
        self._steps = -(-self._path.steps // (config.check_periods - 1))  # in a period, all but the first of a check
        self._no_path = self._path.path
        self._path_clearance = np.zeros((self._path.samples, robots))
        self._start, self._measurements = StartCheck(bundle.limits, config), MeasurementCheck(bundle.limits, config)
        joints = bundle.num_joints
        self.torque, self._value = np.zeros((2, joints, robots))
        self._stiffness = np.ones((joints, robots))
        self._action = np.zeros((bundle.action_size, robots))
        self._left, self._repeats = np.zeros((2, robots), int)
        self.has_action = np.zeros(robots, bool)
        self._pending: _Pending | None = None
        self.reference = Reference(*np.zeros((3, joints, robots)))
        self._begun: tuple[Reference, np.ndarray] | None = None  # references and periods left as the period began
        self.cause = np.full(robots, "", object)
        self.counts = {name: np.zeros(robots, int) for name in INTERVENTIONS}
        self._largest_errors, self.clearance = np.zeros((joints, robots)), np.full(robots, np.inf)
        self._qpos, self._qvel, self._rest = np.zeros((3, joints, robots))
        self._is_tracked = np.ones(robots, bool)

    def start(self, qpos: np.ndarray, qvel: np.ndarray, start_pose: np.ndarray) -> np.ndarray:
        """Begins to control arms that are near their start poses and at rest; gives the cause for those that are not.

        Args:
          qpos, qvel: measured [rad, rad/s].
          start_pose: [joints, robots] [rad].
        """
        self.cause[:] = self._start(qpos, qvel, start_pose)
        clearance = self._clearance(np.nan_to_num(qpos).T)
        self.cause[(self.cause == "") & ~(clearance >= self._config.margin - self._config.creep)] = "start clearance"
        qpos = np.where(np.isfinite(qpos), qpos, start_pose)
        self.reference = Reference(qpos.copy(), np.zeros_like(qpos), np.zeros_like(qpos))
        self._measurements.begin(qpos)
        return self.cause

    def tick(self, action: np.ndarray, is_present: np.ndarray) -> None:
        """Takes the actions of a tick, whose targets act `check_periods` after this period if their paths are safe.

        Args:
          action: [numbers, robots] in [-1, 1].
          is_present: [robots] whether a new action has arrived; otherwise the last one is used again.

        Raises:
          RuntimeError: it is not called between `period` and `work`; nothing has changed then.
        """
        if self._begun is None:
            raise RuntimeError("tick: expected after `period` and before `work`")
        reference, left = self._begun
        is_active = self.cause == ""
        is_valid = np.all(np.abs(action) <= 1 + _ACTION_TOLERANCE, axis=0)  # False for NaN
        self.counts[INVALID] += is_active & is_present & ~is_valid
        is_new = is_present & is_valid
        self._action = np.where(is_new, action, self._action)
        self.has_action |= is_new
        self._repeats = np.where(is_present, 0, self._repeats + 1)
        is_repeated = ~is_present & (self._repeats <= self._config.repeats)
        is_missing = is_active & ~is_present & self.has_action
        self.counts[REPEATED] += is_missing & is_repeated
        self.counts[LATE] += is_missing & ~is_repeated
        self._pending = _Pending(is_active & (is_new | is_repeated) & self.has_action)
        self._path.begin(reference, self._value, left)
        self._path_clearance[:] = -np.inf  # what has not been checked is not safe

    @property
    def tracking_error(self) -> np.ndarray:
        """The largest tracking error [robots] [rad]."""
        return self._largest_errors.max(axis=0)

    @property
    def is_checking(self) -> bool:
        """Whether the check of a target is under way."""
        return self._pending is not None

    def period(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """The torques [N m] of a period, for measured angles [rad] and velocities [rad/s]."""
        if self._pending is not None and self._pending.periods == self._config.check_periods:
            self._accept(self._pending)
        self._qpos, self._qvel, self._begun = qpos, qvel, (self.reference, self._left)
        cause, error = self._measurements(qpos, qvel, self.reference, self.cause)
        np.maximum(self._largest_errors, error, out=self._largest_errors, where=self._is_tracked)
        if cause is not None:
            self._stop(cause)
        self._move_reference()
        stiffness = self._stiffness
        if self._measurements.any_lost:  # no torque where nothing is measured: the robot holds itself
            is_lost = self._measurements.is_lost
            stiffness = np.where(is_lost, 0.0, stiffness)
            qpos, qvel = np.where(is_lost, self.reference.qpos, qpos), np.where(is_lost, self.reference.qvel, qvel)
        target = Target(self._value, stiffness)
        torque = joint_torque("joint_position", qpos, qvel, self.reference, target, self.torque, self._joints, np)
        excess = qvel - np.minimum(np.maximum(qvel, -self._slow), self._slow)
        beyond = qpos - np.minimum(np.maximum(qpos, self._joints.lower), self._joints.upper)
        excess = np.where(beyond * qvel > 0, qvel, excess)
        if np.count_nonzero(excess):
            torque = self._slowed(torque, excess)
        self.torque = torque
        return self.torque

    def _slowed(self, torque: np.ndarray, excess: np.ndarray) -> np.ndarray:
        """Torques that also brake joints by an excess of their velocity, within the limits of the torque."""
        joints = self._joints
        braking = np.clip(torque - _SLOWING * joints.damping * excess, -joints.torque, joints.torque)
        change = joints.torque_rate * PERIOD
        return self.torque + np.clip(braking - self.torque, -change, change)

    def work(self) -> None:
        """Computes a part of the check that is under way, and the clearances of the measured pose and of that part.

        Each period has about the same work, also without a check: code that has not run for some milliseconds takes
        several times as long. Only the first period of a check has none: in it the policy's action is taken.
        """
        pending, first, path, self._begun = self._pending, 0, self._no_path, None
        if pending is not None and pending.periods < self._config.check_periods:
            pending.periods += 1
            if pending.periods == 1:
                return
            first = len(self._path.path)
            self._path.advance(self._steps, self._new_target)
            path = self._path.path[first:]
        clearance = self._clearances(np.concatenate([self._qpos[None], path]))
        self._check_clearance(clearance[0])
        self._path_clearance[first : first + len(path)] = clearance[1:]

    def stop(self, cause: str) -> None:
        """Makes all arms that are controlled brake and hold, for good."""
        self._stop(np.where(self.cause == "", cause, ""))

    def release(self, robots: np.ndarray, cause: str) -> None:
        """No longer controls some arms: their robots stopped by themselves."""
        if np.any(robots & (self.cause != cause)):
            self.cause[robots], self._left[robots], self._is_tracked[robots] = cause, 0, False

    def _check_clearance(self, measured: np.ndarray) -> None:
        """Stops arms whose measured pose has no clearance left."""
        clearance = np.where(np.isnan(measured), np.inf, measured)
        np.minimum(self.clearance, clearance, out=self.clearance, where=self._is_tracked)
        is_near = clearance < self._config.measured_margin
        if np.count_nonzero(is_near):
            self._stop(np.where(is_near, MEASURED_CLEARANCE, ""))

    def _new_target(self, reference: Reference) -> np.ndarray:
        """The target of the pending actions, relative to the reference when they begin to act."""
        target = action_target(self._mode, self._action, reference, self._actions, np)
        assert self._pending is not None
        stiffness = np.maximum(target.stiffness, self._config.min_stiffness)
        self._pending.target = Target(np.array(target.value), stiffness)
        return self._pending.target.value

    def _clearances(self, poses: np.ndarray) -> np.ndarray:
        """The clearances [samples, robots] of poses [samples, joints, robots]."""
        samples, joints, robots = poses.shape
        return self._clearance(poses.transpose(0, 2, 1).reshape(-1, joints)).reshape(samples, robots)

    def _is_safe(self, clearance: np.ndarray) -> np.ndarray:
        """Whether the clearance along each path is above the margin, or not less than where the path begins."""
        floor = self._config.margin - self._config.creep
        required = np.minimum(self._config.margin, np.maximum(clearance[0], floor))
        return np.all(clearance[1:] >= required, axis=0)

    def _accept(self, pending: "_Pending") -> None:
        assert pending.target is not None
        self._pending = None
        is_safe = self._is_safe(self._path_clearance)
        is_accepted = pending.is_candidate & is_safe & (self.cause == "")
        self.counts[COLLISION] += pending.is_candidate & ~is_safe
        self._value = np.where(is_accepted, pending.target.value, self._value)
        self._stiffness = np.where(is_accepted, pending.target.stiffness, self._stiffness)
        self._left = np.where(is_accepted, self._hold, self._left)

    def _stop(self, cause: np.ndarray) -> None:
        """Makes arms brake: those with a cause."""
        is_stopped = (self.cause == "") & (cause != "")
        self.cause[is_stopped] = cause[is_stopped]
        self._left = np.where(is_stopped, 0, self._left)
        self._stiffness[:, is_stopped] = 1.0
        is_blocked = is_stopped & (cause == TRACKING)
        if np.count_nonzero(is_blocked):  # brakes from the measured motion: the reference would push the arm on
            qvel = np.clip(self._qvel, -self._joints.velocity, self._joints.velocity)
            measured = Reference(self._qpos, qvel, self.reference.qacc)
            self.reference = Reference(
                *(np.where(is_blocked, x, y) for x, y in zip(measured, self.reference, strict=True))
            )

    def _move_reference(self) -> None:
        """One period of all references, towards their targets or to rest."""
        is_held = self._left > 0
        held, count = self.reference, np.count_nonzero(is_held)
        if count:
            held = next_reference(self._mode, self.reference, self._value, self._limits, np)
        if count < len(is_held):
            braking = next_reference("joint_velocity", self.reference, self._rest, self._limits, np)
            held = Reference(*(np.where(is_held, x, y) for x, y in zip(held, braking, strict=True)))
        self.reference = held
        self._left = self._left - is_held  # not in place: `_begun` has the last ones


@dataclasses.dataclass
class _Pending:
    """The check of a target.

    Attributes:
      is_candidate: [robots] whether there is a target to check.
      periods: since it began.
      target: computed from the reference when it would begin to act.
    """

    is_candidate: np.ndarray
    periods: int = 0
    target: Target | None = None
