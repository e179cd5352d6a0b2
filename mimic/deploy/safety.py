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
)
from mimic.deploy.bundle import Bundle
from mimic.deploy.config import SafetyConfig
from mimic.deploy.measurements import MeasurementCheck, StartCheck
from mimic.deploy.path import PathPrediction

# Interventions, which replace a target, and the causes for which an arm stops for good.
COLLISION, INVALID, REPEATED, LATE = "clearance", "invalid action", "repeated action", "late policy"
INTERVENTIONS = (COLLISION, INVALID, REPEATED, LATE)
MEASURED_CLEARANCE = "measured clearance"
_CLEARANCE_PERIODS = 3  # of those of a check: a part of the path in each
_SLOWING = 3.0  # of the damping of the inner loop
_ACTION_TOLERANCE = 1e-3  # beyond [-1, 1]: float32 rounds a saturated tanh


class SafetyLayer:
    """The inner loops of some robots with the same controller.

    In each period: `tick` at the start of a tick of the policy, then `period` gives the torques, and `work` computes in
    the rest of the period.

    Args:
      bundle: the controller.
      clearance: gives the clearance [rows] [m] of poses [rows, joints].
      robots: number of robots.
      config: thresholds.

    Attributes:
      reference: the motion that the arms track.
      torque: of the last period [N m].
      cause: [robots] why the arm was stopped for good; empty while it is controlled.
      counts: [robots] number of interventions, by kind.
      tracking_error: [robots] largest tracking error [rad].
      clearance: [robots] smallest clearance of a measured pose [m], of one in several periods.
    """

    def __init__(
        self,
        bundle: Bundle,
        clearance: Callable[[np.ndarray], np.ndarray],
        robots: int = 1,
        config: SafetyConfig | None = None,
    ):
        config = config or SafetyConfig()
        if bundle.mode == "torque":
            raise ValueError(
                "mode: expected joint_position, joint_velocity or joint_impedance, whose targets have a braking path, "
                "got torque"
            )
        hold = bundle.periods + round(config.grace / PERIOD)
        if bundle.periods <= config.check_periods or hold % 10:
            raise ValueError(
                f"control_dt, grace: expected a tick of more than {config.check_periods} ms, and a multiple of 10 ms "
                f"together, got {bundle.control_dt} s and {config.grace} s"
            )
        self._mode, self._config, self._clearance, self._hold = bundle.mode, config, clearance, hold
        self._actions = JointParameters(*(np.asarray(x, float)[:, None] for x in bundle.parameters))
        self._joints = self._actions._replace(
            velocity=config.velocity_scale * self._actions.velocity,
            acceleration=config.acceleration_scale * self._actions.acceleration,
        )
        self._slow = config.slow_down * np.asarray(bundle.limits.velocity)[:, None]
        is_position = bundle.mode != "joint_velocity"
        self._path = PathPrediction(self._joints, is_position, config.check_periods, hold, robots)
        self._path_periods = config.check_periods - _CLEARANCE_PERIODS
        self._steps = -(-self._path.steps // (self._path_periods - self._path_periods // 2))  # in each second period
        self._start, self._measurements = StartCheck(bundle.limits, config), MeasurementCheck(bundle.limits, config)
        joints = bundle.num_joints
        self.torque, self._value = np.zeros((2, joints, robots))
        self._stiffness = np.ones((joints, robots))
        self._action = np.zeros((bundle.action_size, robots))
        self._left, self._repeats = np.zeros((2, robots), int)
        self._has_action = np.zeros(robots, bool)
        self._pending: _Pending | None = None
        self.reference = Reference(*np.zeros((3, joints, robots)))
        self.cause = np.full(robots, "", object)
        self.counts = {name: np.zeros(robots, int) for name in INTERVENTIONS}
        self.tracking_error, self.clearance = np.zeros(robots), np.full(robots, np.inf)
        self._qpos, self._is_tracked = np.zeros((joints, robots)), np.ones(robots, bool)

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
        """Takes the actions of a tick, whose targets act after `check_periods` if their paths are safe.

        Args:
          action: [numbers, robots] in [-1, 1].
          is_present: [robots] whether a new action has arrived; otherwise the last one is used again.
        """
        is_active = self.cause == ""
        is_valid = np.all(np.abs(action) <= 1 + _ACTION_TOLERANCE, axis=0)  # False for NaN
        self.counts[INVALID] += is_active & is_present & ~is_valid
        is_new = is_present & is_valid
        self._action = np.where(is_new, action, self._action)
        self._has_action |= is_new
        self._repeats = np.where(is_present, 0, self._repeats + 1)
        is_repeated = ~is_present & (self._repeats <= self._config.repeats)
        is_missing = is_active & ~is_present & self._has_action
        self.counts[REPEATED] += is_missing & is_repeated
        self.counts[LATE] += is_missing & ~is_repeated
        self._pending = _Pending(is_active & (is_new | is_repeated) & self._has_action)
        self._path.begin(self.reference, self._value, self._left)

    @property
    def is_checking(self) -> bool:
        """Whether the check of a target is under way."""
        return self._pending is not None

    def period(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """The torques [N m] of a period, for measured angles [rad] and velocities [rad/s]."""
        if self._pending is not None and self._pending.periods == self._config.check_periods:
            self._accept(self._pending)
        self._qpos = qpos
        cause, error = self._measurements(qpos, qvel, self.reference, self.cause)
        np.maximum(self.tracking_error, error, out=self.tracking_error, where=self._is_tracked)
        if cause is not None:
            self._stop(cause)
        self._move_reference()
        stiffness, is_lost = self._stiffness, self._measurements.is_lost
        if is_lost.any():  # no torque where nothing is measured: the robot holds itself
            stiffness = np.where(is_lost, 0.0, stiffness)
            qpos, qvel = np.where(is_lost, self.reference.qpos, qpos), np.where(is_lost, self.reference.qvel, qvel)
        target = Target(self._value, stiffness)
        torque = joint_torque("joint_position", qpos, qvel, self.reference, target, self.torque, self._joints, np)
        excess = qvel - np.minimum(np.maximum(qvel, -self._slow), self._slow)
        self.torque = self._slowed(torque, excess) if excess.any() else torque
        return self.torque

    def _slowed(self, torque: np.ndarray, excess: np.ndarray) -> np.ndarray:
        """Torques that also brake joints beyond `slow_down`, by some velocity, within the limits of the torque."""
        joints = self._joints
        braking = np.clip(torque - _SLOWING * joints.damping * excess, -joints.torque, joints.torque)
        change = joints.torque_rate * PERIOD
        return self.torque + np.clip(braking - self.torque, -change, change)

    def work(self) -> None:
        """Computes a part of the check that is under way, or the clearance of the measured pose."""
        pending = self._pending
        if pending is None or pending.periods >= self._config.check_periods:
            self._check_clearance()
            return
        pending.periods += 1
        part = pending.periods - self._path_periods
        if part <= 0 and pending.periods % 2:
            self._path.advance(self._steps, self._new_target)
        elif part <= 0:  # in between, or the caches lose onnxruntime's code, and the next calls take 0.4 ms
            self._check_clearance()
        elif part <= _CLEARANCE_PERIODS:
            pending.clearance.append(self._clearance_of(self._path.parts(_CLEARANCE_PERIODS)[part - 1]))

    def stop(self, cause: str) -> None:
        """Makes all arms that are controlled brake and hold, for good."""
        self._stop(np.where(self.cause == "", cause, ""))

    def release(self, robots: np.ndarray, cause: str) -> None:
        """No longer controls some arms: their robots stopped by themselves."""
        if np.any(robots & (self.cause != cause)):
            self.cause[robots], self._left[robots], self._is_tracked[robots] = cause, 0, False

    def _check_clearance(self) -> None:
        """Stops arms whose measured pose has no clearance left."""
        clearance = np.nan_to_num(self._clearance(self._qpos.T), nan=np.inf)
        np.minimum(self.clearance, clearance, out=self.clearance, where=self._is_tracked)
        if clearance.min() < self._config.measured_margin:
            self._stop(np.where(clearance < self._config.measured_margin, MEASURED_CLEARANCE, ""))

    def _new_target(self, reference: Reference) -> np.ndarray:
        """The target of the pending actions, relative to the reference when they begin to act."""
        target = action_target(self._mode, self._action, reference, self._actions, np)
        assert self._pending is not None
        stiffness = np.maximum(target.stiffness, self._config.min_stiffness)
        self._pending.target = Target(np.array(target.value), stiffness)
        return self._pending.target.value

    def _clearance_of(self, path: np.ndarray) -> np.ndarray:
        """The clearance [samples, robots] of a part of the paths."""
        samples, joints, robots = path.shape
        return self._clearance(path.transpose(0, 2, 1).reshape(-1, joints)).reshape(samples, robots)

    def _is_safe(self, clearance: np.ndarray) -> np.ndarray:
        """Whether the clearance along each path is above the margin, or not less than where the path begins."""
        floor = self._config.margin - self._config.creep
        required = np.minimum(self._config.margin, np.maximum(clearance[0], floor))
        return np.all(clearance[1:] >= required, axis=0)

    def _accept(self, pending: "_Pending") -> None:
        assert pending.target is not None
        self._pending = None
        is_safe = self._is_safe(np.concatenate(pending.clearance))
        is_accepted = pending.is_candidate & is_safe & (self.cause == "")
        self.counts[COLLISION] += pending.is_candidate & ~is_safe
        self._value = np.where(is_accepted, pending.target.value, self._value)
        self._stiffness = np.where(is_accepted, pending.target.stiffness, self._stiffness)
        self._left = np.where(is_accepted, self._hold, self._left)

    def _stop(self, cause: np.ndarray) -> None:
        """Makes arms brake: those with a cause."""
        is_stopped = (self.cause == "") & (cause != "")
        self.cause[is_stopped] = cause[is_stopped]
        self._left[is_stopped] = 0
        self._stiffness[:, is_stopped] = 1.0

    def _move_reference(self) -> None:
        """One period of all references, towards their targets or to rest."""
        is_held = self._left > 0
        all_held = bool(is_held.all())
        held = braking = self.reference
        if is_held.any():
            held = next_reference(self._mode, self.reference, self._value, self._joints, np)
        if not all_held:
            zero = np.zeros_like(self._value)
            braking = next_reference("joint_velocity", self.reference, zero, self._joints, np)
        if all_held:
            self.reference = held
        else:
            self.reference = Reference(*(np.where(is_held, x, y) for x, y in zip(held, braking, strict=True)))
        np.maximum(self._left - 1, 0, out=self._left)


@dataclasses.dataclass
class _Pending:
    """The check of a target.

    Attributes:
      is_candidate: [robots] whether there is a target to check.
      periods: since it began.
      target: computed from the reference when it would begin to act.
      clearance: [samples, robots] of the parts of the paths that were checked [m].
    """

    is_candidate: np.ndarray
    periods: int = 0
    target: Target | None = None
    clearance: list[np.ndarray] = dataclasses.field(default_factory=list)
