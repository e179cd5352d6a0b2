"""Runs a motion of a bundle on a robot."""

import contextlib
import dataclasses
import gc
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from mimic.control.joint_control import PERIOD, Reference
from mimic.deploy.bundle import Bundle
from mimic.deploy.clearance import Clearance
from mimic.deploy.config import SafetyConfig
from mimic.deploy.cores import awake_core
from mimic.deploy.driver import Driver, RobotAbort, RobotState
from mimic.deploy.policy_process import PolicyProcess
from mimic.deploy.safety import INTERVENTIONS, INVALID, LATE, SafetyLayer

INTERRUPTED = "interrupted"
_REST = 1e-3  # rad/s, of a reference that has stopped
_AT_REST = 200  # periods that the arm is held at the end, for its tracking error to decay
_MAX_STOP = 2000  # periods to brake and hold, many times what it takes
_LATEST = 10  # periods after the start of a tick at which the last action is used again


class PolicyConnection(Protocol):
    """A policy, as `LocalPolicy` and `PolicyProcess` are."""

    def send(self, tick: int, qpos: np.ndarray, qvel: np.ndarray, reference: Reference, /) -> None: ...  # noqa: D102

    def receive(self) -> tuple[int, np.ndarray] | None: ...  # noqa: D102

    def close(self) -> None: ...  # noqa: D102


@dataclasses.dataclass(frozen=True)
class Report:
    """What happened in a run.

    Attributes:
      cause: why the arm was stopped or the robot aborted; empty where the motion was completed.
      aborted: whether the robot stopped by itself.
      ticks: of the policy that were run.
      waited: those before its first valid action, in which the arm stood still.
      interventions: number of interventions of the safety layer, by kind.
      tracking_error: largest difference between a measured angle and the reference [rad].
      clearance: smallest clearance of a measured pose [m].
      latency_ms: wall times from a state to its torque [ms]: p50, p99, p99.9 and max.
      compute_ms: the same of all that is computed in a period.
      cpu_ms: the same of its CPU time, which other processes on the computer do not add to.
      latency_s, wall_s, cpu_s: the times of each period [s].
    """

    cause: str
    aborted: bool
    ticks: int
    waited: int
    interventions: dict[str, int]
    tracking_error: float
    clearance: float
    latency_ms: dict[str, float]
    compute_ms: dict[str, float]
    cpu_ms: dict[str, float]
    latency_s: list[float]
    wall_s: list[float]
    cpu_s: list[float]

    @property
    def is_complete(self) -> bool:
        """Whether the whole motion was run, under the policy's control, and all of its actions were valid."""
        return not (self.cause or self.waited or self.interventions[LATE] or self.interventions[INVALID])

    def as_dict(self) -> dict[str, Any]:
        """The report for JSON, without the times of each period."""
        fields = dataclasses.asdict(self)
        del fields["latency_s"], fields["wall_s"], fields["cpu_s"]
        return {**fields, "is_complete": self.is_complete}


def run_controller(
    driver: Driver,
    bundle: Bundle,
    motion: int | str = 0,
    *,
    config: SafetyConfig | None = None,
    policy: PolicyConnection | None = None,
    cores: tuple[int, int] | None = None,
) -> Report:
    """Runs a motion on a robot, from its start pose until the arm is at rest again.

    The first Ctrl-C makes the arm brake; when it is at rest and the driver has stopped, it is raised again. A second
    one stops the driver at once.

    Args:
      driver: of the robot.
      bundle: see `load_bundle`.
      motion: index or name of the motion.
      config: thresholds of the safety layer.
      policy: connection to the policy; default: the bundle's policy in a new process.
      cores: of the inner loop and of the policy's new process, which may be the same; they do not halt during the run,
        see `awake_core` and `PolicyProcess`. Linux only. Default: any cores.

    Raises:
      ValueError: there is no such motion or core, cores that are not a pair, cores and a given policy, or the bundle's
        mode has no braking path.
      RuntimeError: the policy's process does not start.
      OSError: these cores are not allowed.
      KeyboardInterrupt: Ctrl-C, after the arm has been stopped.
    """
    if policy is not None and cores is not None:
        raise ValueError(f"cores: expected None with a given policy, got {cores}")
    core, policy_core = (None, None) if cores is None else _core_pair(cores)
    index = bundle.motion_index(motion)
    layer = SafetyLayer(bundle, Clearance(bundle), config=config)
    with awake_core(core):
        connection = policy or PolicyProcess(bundle, index, core=None if policy_core == core else policy_core)
        loop = _Loop(driver, bundle, layer, connection)
        try:
            with _interrupts_noted(loop), _without_collection():
                loop.run(bundle.start_poses[index])
        except RobotAbort as abort:
            return loop.report(abort.cause, aborted=True)
        finally:
            try:
                with contextlib.suppress(RobotAbort):
                    driver.stop()  # first: meanwhile the robot gets no commands
            finally:
                connection.close()
    return loop.report(str(layer.cause[0]), aborted=False)


def _core_pair(cores: Any) -> tuple[int, int]:
    """Two cores, or a ValueError."""
    numbers = tuple(cores) if isinstance(cores, tuple | list) else ()
    if len(numbers) != 2 or not all(isinstance(x, int | np.integer) and not isinstance(x, bool) for x in numbers):
        raise ValueError(f"cores: expected a pair of core numbers such as (0, 1), got {cores!r:.80}")
    return int(numbers[0]), int(numbers[1])


class _Loop:
    """The periods of a run; where `is_interrupted` is set, the arm brakes from the next one on."""

    def __init__(self, driver: Driver, bundle: Bundle, layer: SafetyLayer, policy: PolicyConnection):
        self._driver, self._bundle, self._layer, self._policy = driver, bundle, layer, policy
        self._latency: list[float] = []
        self._wall: list[float] = []
        self._cpu: list[float] = []
        self._tick, self._due, self._action = -1, False, np.zeros((bundle.action_size, 1))
        self._waited, self.is_interrupted = 0, False

    def run(self, start_pose: np.ndarray) -> None:
        """Runs all ticks, then brakes and holds."""
        state = self._driver.read()
        cause = self._layer.start(state.qpos[:, None], state.qvel[:, None], start_pose[:, None])
        if cause[0]:
            return
        is_first = True
        for period in range(self._bundle.ticks * self._bundle.periods):
            state = state if is_first else self._driver.read()
            self._period(state, period)
            is_first = False
            if self.is_interrupted:
                self._layer.stop(INTERRUPTED)
            if self._layer.cause[0]:
                break
        self._due, at_rest = False, 0
        for _ in range(_MAX_STOP):
            self._period(self._driver.read(), None)
            at_rest = at_rest + 1 if np.abs(self._layer.reference.qvel).max() < _REST else 0
            if at_rest > _AT_REST:
                break

    def _period(self, state: RobotState, period: int | None) -> None:
        """One period; `period` counts those of the motion, None after its end."""
        wall, cpu = time.perf_counter(), time.thread_time()
        tick, since = divmod(period or 0, self._bundle.periods)  # after the end of the motion nothing is due
        is_tick = period is not None and since == 0
        torque = self._layer.period(state.qpos[:, None], state.qvel[:, None])
        self._driver.write(torque[:, 0])
        self._latency.append(time.perf_counter() - wall)
        reference = self._layer.observed_reference if is_tick else None
        if self._due and not self._layer.is_checking:
            self._receive(since)
        if reference is None or self._layer.is_checking:  # at a tick only if it must: the policy may wait for this core
            self._layer.work()
        if reference is not None:
            self._policy.send(tick, state.qpos, state.qvel, Reference(*(x[:, 0] for x in reference)))
            self._tick, self._due = tick, True
        self._wall.append(time.perf_counter() - wall)
        self._cpu.append(time.thread_time() - cpu)

    def _receive(self, since: int) -> None:
        """Begins the check of the tick's action when it has arrived, some periods after the start of the tick."""
        received = self._policy.receive()
        is_present = received is not None and received[0] == self._tick
        if is_present or since >= _LATEST:
            if received is not None and is_present:
                self._action = received[1][:, None]
            self._layer.tick(self._action, np.array([is_present]))
            self._waited += not self._layer.has_action[0]
            self._due = False

    def report(self, cause: str, *, aborted: bool) -> Report:
        """The report of the run."""
        counts = {name: int(self._layer.counts[name][0]) for name in INTERVENTIONS}
        error = float(self._layer.tracking_error[0])
        clearance, seconds = float(self._layer.clearance[0]), (self._latency, self._wall, self._cpu)
        latency, compute, cpu = map(_percentiles, seconds)
        return Report(
            cause, aborted, self._tick + 1, self._waited, counts, error, clearance, latency, compute, cpu, *seconds
        )


def _percentiles(seconds: list[float]) -> dict[str, float]:
    values = 1e3 * np.asarray(seconds or [0.0])
    p50, p99, p999 = np.percentile(values, [50, 99, 99.9])
    return {"p50": float(p50), "p99": float(p99), "p99.9": float(p999), "max": float(values.max())}


@contextlib.contextmanager
def _without_collection() -> Iterator[None]:
    """Context without garbage collection, which would take a period or more."""
    was_enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextlib.contextmanager
def _interrupts_noted(loop: _Loop) -> Iterator[None]:
    """Context in which the first Ctrl-C only sets `is_interrupted`, and is raised at the end.

    Raised at any moment it would leave a period without a torque, or a torque that was computed but not commanded.
    """
    previous = signal.getsignal(signal.SIGINT)
    if not callable(previous) or threading.current_thread() is not threading.main_thread():
        yield  # it is ignored, or raised in another thread
        return

    def note(*_: object) -> None:
        loop.is_interrupted = True
        signal.signal(signal.SIGINT, previous)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
        if loop.is_interrupted:
            signal.raise_signal(signal.SIGINT)


def missed_periods(states: list[RobotState]) -> int:
    """Periods of the robot's clock without a state among these."""
    times = np.array([state.time for state in states])
    return int(np.maximum(np.round(np.diff(times) / PERIOD) - 1, 0).sum())
