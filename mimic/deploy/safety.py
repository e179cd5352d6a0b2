"""The safety layer: the inner loop of some robots at 1 kHz, which accepts a target only if it can stop after it.

Each accepted target comes with a path that was checked: the target acts for a tick and a grace time, then the reference
brakes. A target that is rejected, late or missing changes nothing: the arm then brakes along the path that was checked.
All arrays are [joints, robots]: a robot alone and thousands in simulation run the same code.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from mimic.control.joint_control import PERIOD, JointParameters, Reference, Target, action_target
from mimic.deploy.bundle import Bundle
from mimic.deploy.config import SafetyConfig
from mimic.deploy.inner_loop import InnerLoop
from mimic.deploy.joint_motion import State, joint_reference
from mimic.deploy.measurements import TRACKING, MeasurementCheck, StartCheck
from mimic.deploy.path import SAMPLE, PathPrediction

# Interventions, which replace a target, and the causes for which an arm stops for good.
COLLISION, INVALID, REPEATED, LATE = "clearance", "invalid action", "repeated action", "late policy"
INTERVENTIONS = (COLLISION, INVALID, REPEATED, LATE)
MEASURED_CLEARANCE = "measured clearance"
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


def _parts(path: PathPrediction, config: SafetyConfig) -> list[int]:
    """Steps of a path in each second period of a check, without the first and the last one.

    Those of braking have several samples each, whose clearance takes time too. So they are spread over two thirds of
    the periods, though they are fewer.
    """
    count = max(config.check_periods // 2 - 1, 1)
    hold, brake = count // 3, count - count // 3
    ends = np.concatenate(
        [[0], np.linspace(0, path.hold_steps, hold + 1)[1:], np.linspace(path.hold_steps, path.steps, brake + 1)[1:]]
    )
    return np.diff(np.ceil(ends).astype(int)).tolist()


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
      cause: [robots] why the arm was stopped for good; empty while it is controlled.
      has_action: [robots] whether a valid action has ever arrived.
      counts: [robots] number of interventions, by kind.
      clearance: [robots] smallest clearance of a measured pose [m], but for the last two periods.
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
        full = (np.tile(np.asarray(x, float)[:, None], robots) for x in (*bundle.parameters, bundle.limits.velocity))
        *parameters, velocity = full
        self._actions = JointParameters(*parameters)
        self._joints = self._actions._replace(
            velocity=config.velocity_scale * self._actions.velocity,
            acceleration=config.acceleration_scale * self._actions.acceleration,
        )
        is_position = bundle.mode != "joint_velocity"
        self._inner_loop = InnerLoop(self._joints, is_position, config.slow_down * velocity)
        self._path = PathPrediction(self._joints, is_position, config.check_periods, hold, robots)
        self._parts = _parts(self._path, config)
        self._path_clearance = np.zeros((self._path.samples, robots))
        self._start = StartCheck(bundle.limits, config)
        self._measurements = MeasurementCheck(bundle.limits, config, robots)
        self._size = bundle.num_joints, robots
        self._value, self._stiffness = np.zeros(self._size), np.ones(self._size)
        self._action = np.zeros((bundle.action_size, robots))
        self._left, self._repeats = [0] * robots, np.zeros(robots, int)  # periods that the targets still act
        self.has_action = np.zeros(robots, bool)
        self._pending: _Pending | None = None
        self._checked = 0  # angles of the path whose clearance has been computed
        self._begun: tuple[list[State], list[int]] | None = None  # references and periods left as the period began
        self.cause = np.full(robots, "", object)
        self.counts = {name: np.zeros(robots, int) for name in INTERVENTIONS}
        self.clearance = np.full(robots, np.inf)
        self._qpos: list[float] = []
        self._qvel: list[float] = []
        self._measured: list[list[float]] = []  # angles whose clearance has not been computed
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
        self._inner_loop.set_reference(Reference(qpos, np.zeros_like(qpos), np.zeros_like(qpos)))
        self._measurements.begin(qpos.ravel().tolist())
        return self.cause

    def tick(self, action: np.ndarray, is_present: np.ndarray) -> None:
        """Takes the actions of a tick, whose targets act `check_periods` after this period if their paths are safe.

        Args:
          action: [numbers, robots] in [-1, 1].
          is_present: [robots] whether a new action has arrived; otherwise the last one is used again.

        Raises:
          RuntimeError: it is not called between `period` and `work`; nothing has changed then.
        """
        states, left = self._beginning("tick")
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
        self._path.begin(joint_reference(states, self._size), self._value, np.array(left))
        self._checked, self._path_clearance[:] = 0, -np.inf  # what has not been checked is not safe

    @property
    def reference(self) -> Reference:
        """The motion that the arms track, [joints, robots] each."""
        return self._inner_loop.reference

    @property
    def observed_reference(self) -> Reference:
        """The motion that the arms tracked when the states of this period were measured, [joints, robots] each.

        Raises:
          RuntimeError: it is not read between `period` and `work`.
        """
        return joint_reference(self._beginning("observed_reference")[0], self._size)

    @property
    def torque(self) -> np.ndarray:
        """The torques [joints, robots] of the last period [N m]."""
        return self._inner_loop.torque

    @property
    def tracking_error(self) -> np.ndarray:
        """The largest tracking error [robots] [rad]."""
        return self._measurements.tracking_error

    @property
    def is_checking(self) -> bool:
        """Whether the check of a target is under way."""
        return self._pending is not None

    def period(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """The torques [N m] of a period, for measured angles [rad] and velocities [rad/s]."""
        inner_loop = self._inner_loop
        self._qpos, self._qvel = qpos.ravel().tolist(), qvel.ravel().tolist()
        self._measured.append(self._qpos)
        self._begun = inner_loop.states, self._left
        cause = self._measurements(self._qpos, self._qvel, inner_loop.states)
        if cause is not None:
            self._stop(cause)
        is_held = [left > 0 for left in self._left] * self._size[0]
        self._left = [max(left - 1, 0) for left in self._left]
        inner_loop.period(self._qpos, self._qvel, is_held, self._measurements.is_lost)
        return inner_loop.torque

    def work(self) -> None:
        """Computes a part of the check that is under way, and the clearance of measured poses.

        It computes steps of the path in one period and clearances in the next one: so less code runs in a period, and
        less of it is missing in the processor's caches. In the first period of a check the policy's action is taken, in
        the last one the target is accepted or not.
        """
        self._begun, pending = None, self._pending
        if pending is None:
            if len(self._measured) > 1:
                self._compute_clearances()
            return
        pending.periods += 1
        turn, is_odd = divmod(pending.periods, 2)
        is_last = pending.periods == self._config.check_periods
        if not is_odd and turn <= len(self._parts):
            self._path.advance(self._parts[turn - 1], self._new_target)
        if (is_odd and turn) or is_last:
            self._compute_clearances()
        if is_last:
            self._accept(pending)

    def stop(self, cause: str) -> None:
        """Makes all arms that are controlled brake and hold, for good."""
        self._stop(np.full(len(self.cause), cause, object))

    def release(self, robots: np.ndarray, cause: str) -> None:
        """No longer controls some arms: their robots stopped by themselves."""
        if np.any(robots & (self.cause != cause)):
            self.cause[robots], self._is_tracked[robots] = cause, False
            self._left = np.where(robots, 0, self._left).tolist()
            self._measurements.release(robots)

    def _beginning(self, name: str) -> tuple[list[State], list[int]]:
        """The references and the periods left as the period began; `name` of what asks is for the error."""
        if self._begun is None:
            raise RuntimeError(f"{name}: expected after `period` and before `work`")
        return self._begun

    def _compute_clearances(self) -> None:
        """The clearances of poses that were measured, and of angles of the path, since the last time."""
        first, (joints, robots) = self._checked, self._size
        path, measured = self._path.path[first:], np.reshape(self._measured, (-1, joints, robots))
        poses = np.concatenate([measured, path]).transpose(0, 2, 1).reshape(-1, joints)
        clearance = self._clearance(poses).reshape(-1, robots)
        self._check_measured(clearance[: len(measured)])
        self._checked = first + len(path)
        self._path_clearance[first : self._checked] = clearance[len(measured) :]
        self._measured = []

    def _check_measured(self, clearance: np.ndarray) -> None:
        """Stops arms for which one of some measured poses [poses, robots] has no clearance left."""
        smallest = np.where(np.isnan(clearance), np.inf, clearance).min(axis=0)
        np.minimum(self.clearance, smallest, out=self.clearance, where=self._is_tracked)
        is_near = smallest < self._config.measured_margin
        if np.count_nonzero(is_near):
            self._stop(np.where(is_near, MEASURED_CLEARANCE, ""))

    def _new_target(self, reference: Reference) -> np.ndarray:
        """The target of the pending actions, relative to the reference when they begin to act."""
        target = action_target(self._mode, self._action, reference, self._actions, np)
        assert self._pending is not None
        stiffness = np.maximum(target.stiffness, self._config.min_stiffness)
        self._pending.target = Target(np.array(target.value), stiffness)
        return self._pending.target.value

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
        self._inner_loop.set_targets(self._value, self._stiffness)
        self._left = np.where(is_accepted, self._hold, self._left).tolist()

    def _stop(self, cause: np.ndarray) -> None:
        """Makes arms brake: those with a cause that have not been stopped yet."""
        is_stopped = (self.cause == "") & (cause != "")
        if not np.count_nonzero(is_stopped):
            return
        self.cause[is_stopped] = cause[is_stopped]
        self._left = np.where(is_stopped, 0, self._left).tolist()
        self._stiffness = np.where(is_stopped, 1.0, self._stiffness)
        self._inner_loop.set_targets(self._value, self._stiffness)
        is_blocked = is_stopped & (cause == TRACKING)
        if np.count_nonzero(is_blocked):  # brakes from the measured motion: the reference would push the arm on
            reference, most = self.reference, self._joints.velocity
            qpos, qvel = np.reshape(self._qpos, self._size), np.clip(np.reshape(self._qvel, self._size), -most, most)
            measured = Reference(qpos, qvel, reference.qacc)
            self._inner_loop.set_reference(
                Reference(*(np.where(is_blocked, x, y) for x, y in zip(measured, reference, strict=True)))
            )


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
