"""Runs a motion of a bundle on a robot, at the rate of the policy."""

import contextlib
import dataclasses
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from mimic.control.joint_control import Reference
from mimic.deploy.bundle import Bundle
from mimic.deploy.config import SafetyConfig
from mimic.deploy.driver import Command, Driver, RobotAbort
from mimic.deploy.policy import Policy
from mimic.deploy.safety import INTERVENTIONS, INVALID, LATE, SafetyLayer

INTERRUPTED = "interrupted"


class Clock(Protocol):
    """The time of a run [s]."""

    def wait_until(self, due: float) -> float:
        """Waits until a time since the first call, and returns the time that it is then."""
        ...


class WallClock:
    """The time of the computer."""

    def __init__(self) -> None:
        self._start: float | None = None

    def wait_until(self, due: float) -> float:
        """See `Clock`."""
        now = time.perf_counter()
        self._start = now if self._start is None else self._start
        time.sleep(max(self._start + due - now, 0.0))
        return time.perf_counter() - self._start


class TickPolicy(Protocol):
    """What gives the actions, as `Policy` does; all arrays are [robots, ...]."""

    def act(self, tick: int, qpos: np.ndarray, qvel: np.ndarray, reference: Reference) -> np.ndarray:
        """The actions of a tick, see `Policy`."""
        ...


@dataclasses.dataclass(frozen=True)
class Report:
    """What happened in a run.

    Attributes:
      cause: why the arm was stopped or the robot aborted; empty where the motion was completed.
      aborted: whether the robot stopped by itself.
      ticks: of the policy that were run.
      interventions: number of interventions of the safety layer, by kind.
      tracking_error: largest difference between a measured angle and the reference [rad].
      clearance: smallest clearance of a measured pose [m].
      latency: longest time from the start of a tick to its command [s].
    """

    cause: str
    aborted: bool
    ticks: int
    interventions: dict[str, int]
    tracking_error: float
    clearance: float
    latency: float

    @property
    def is_complete(self) -> bool:
        """Whether the whole motion was run in time, and all actions were valid."""
        return not (self.cause or self.interventions[LATE] or self.interventions[INVALID])

    def as_dict(self) -> dict[str, Any]:
        """The report for JSON."""
        return {**dataclasses.asdict(self), "is_complete": self.is_complete}


def run_controller(
    driver: Driver,
    bundle: Bundle,
    motion: int | str = 0,
    *,
    config: SafetyConfig | None = None,
    policy: TickPolicy | None = None,
    clock: Clock | None = None,
) -> Report:
    """Runs a motion on a robot, from its start pose until the arm is at rest again.

    The first Ctrl-C makes the arm brake; when it is at rest and the driver has stopped, it is raised again. A second
    one stops the driver at once.

    Args:
      driver: of the robot.
      bundle: see `load_bundle`.
      motion: index or name of the motion.
      config: thresholds of the safety layer.
      policy: default: that of the bundle.
      clock: of the run; default: the computer's. A robot in simulation is its own.

    Raises:
      ValueError: there is no such motion, or the bundle's mode has no braking path.
      KeyboardInterrupt: Ctrl-C, after the arm has been stopped.
    """
    index = bundle.motion_index(motion)
    layer = SafetyLayer(bundle, config=config)
    run = _Run(driver, bundle, layer, policy or Policy(bundle, [index]), clock or WallClock())
    try:
        with _interrupts_noted(run):
            run.run(bundle.start_poses[index], (config or SafetyConfig()).latency)
    except RobotAbort as abort:
        return run.report(abort.cause, aborted=True)
    finally:
        with contextlib.suppress(RobotAbort):
            driver.stop()
    return run.report(str(layer.cause[0]), aborted=False)


class _Run:
    """The ticks of a run; where `is_interrupted` is set, the arm brakes from the next one on."""

    def __init__(self, driver: Driver, bundle: Bundle, layer: SafetyLayer, policy: TickPolicy, clock: Clock):
        self._driver, self._bundle, self._layer, self._policy, self._clock = driver, bundle, layer, policy, clock
        self._ticks, self._latency, self.is_interrupted = 0, 0.0, False

    def run(self, start_pose: np.ndarray, latency: float) -> None:
        """Runs all ticks, then brakes; `latency` is from the start of a tick to its command [s]."""
        state, layer = self._driver.read(), self._layer
        if layer.start(state.qpos[:, None], state.qvel[:, None], start_pose[:, None])[0]:
            return
        control_dt, tick, last = self._bundle.control_dt, 0, self._bundle.ticks
        while tick < last + layer.brake_ticks:
            due = tick * control_dt
            overdue = int((self._clock.wait_until(due) - due) / control_dt + 1e-6)
            for _ in range(overdue):
                layer.skip()
            tick += overdue
            is_braking = tick >= last or bool(layer.cause[0])
            last = min(last, tick) if is_braking else last
            command = self._tick(tick, is_braking=is_braking)
            now = self._clock.wait_until(tick * control_dt + latency)
            self._latency = max(self._latency, now - tick * control_dt)
            self._driver.write(command)
            tick += 1
        self._clock.wait_until(tick * control_dt + latency)

    def _tick(self, tick: int, *, is_braking: bool) -> Command:
        """The command of a tick, from its measurement on."""
        state, layer = self._driver.read(), self._layer
        if self.is_interrupted:
            layer.stop(INTERRUPTED)
        action = None
        if not is_braking:
            reference = Reference(*(x.T for x in layer.reference))
            action = self._policy.act(tick, state.qpos[None], state.qvel[None], reference).T
            self._ticks += 1
        command = layer.tick(state.qpos[:, None], state.qvel[:, None], action)
        path = Reference(*(x[..., 0] for x in command.path))
        return Command(path, command.stop[:, 0])

    def report(self, cause: str, *, aborted: bool) -> Report:
        """The report of the run."""
        layer = self._layer
        counts = {name: int(layer.counts[name][0]) for name in INTERVENTIONS}
        error, clearance = float(layer.tracking_error[0]), float(layer.clearance[0])
        return Report(cause, aborted, self._ticks, counts, error, clearance, self._latency)


@contextlib.contextmanager
def _interrupts_noted(run: _Run) -> Iterator[None]:
    """Context in which the first Ctrl-C only sets `is_interrupted`, and is raised at the end.

    Raised at any moment it would leave a command that was computed but not sent.
    """
    previous = signal.getsignal(signal.SIGINT)
    if not callable(previous) or threading.current_thread() is not threading.main_thread():
        yield  # it is ignored, or raised in another thread
        return

    def note(*_: object) -> None:
        run.is_interrupted = True
        signal.signal(signal.SIGINT, previous)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
        if run.is_interrupted:
            signal.raise_signal(signal.SIGINT)
