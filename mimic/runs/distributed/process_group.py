"""Training in several processes: they connect by `jax.distributed`, train in step, and end together.

Only the first process writes and evaluates, while the others wait for it in their next training epoch.
So the first process announces the end of a training through JAX's coordination service. A failure, or a signal that
only one process received, is announced in the same way. A process that is killed or stopped announces nothing: the
others end by the errors of their connections to it, or by JAX when its heartbeats stay out.
"""

import atexit
import contextlib
import dataclasses
import os
import re
import sys
import threading
from collections.abc import Callable
from typing import NoReturn

import jax

from mimic.base import compat
from mimic.base.ranges import check_ranges, number
from mimic.runs.distributed.local_processes import LocalProcesses, gpu_count, local_process
from mimic.runs.signals import EXIT_HOOKS, STOPPED_BY_SIGNAL, Signals

AUTO, LOCAL = "auto", "local"
_ENDED, _SIGNAL = "mimic/ended", "mimic/signal"  # keys of the coordination service
_POLL_S = 0.5
_CONNECTION_ERROR = re.compile("gloo|nccl|connection|socket|timed? ?out|deadline", re.IGNORECASE)
_HEARTBEAT_S = 30  # JAX ends all processes if one is silent for that long; Python may hold it up while it traces
_SHUTDOWN_S = 60  # timeout for the last process to disconnect
_GRACE_S = 3  # the same error may occur in two processes with this delay
_FAILED = 1


@dataclasses.dataclass(frozen=True)
class DistributedConfig:
    """The processes of a distributed training; each is started with the same command, except for its number.

    Attributes:
      coordinator: HOST:PORT of the first process, where all connect; "auto" under Slurm and Open MPI, which set all
        three fields; "local" for processes on this host, which the first process starts; empty for a single process.
      processes: number of processes; with "local" one for each GPU where None.
      process: number of this process; process 0 evaluates and writes the run directory.
    """

    coordinator: str = ""
    processes: int | None = number(None, at_least=1, at_most=100_000)
    process: int | None = number(None, at_least=0, at_most=100_000)

    def __post_init__(self) -> None:
        numbers = {"processes": self.processes, "process": self.process}
        allowed = {"": (), AUTO: (), LOCAL: ("processes",)}.get(self.coordinator, tuple(numbers))
        for key, value in numbers.items():
            if value is not None and key not in allowed:
                raise ValueError(
                    f"distributed.{key}: not expected, got {value} with distributed.coordinator={self.coordinator!r}"
                )
        check_ranges(self, "distributed.")
        if self.coordinator in ("", AUTO, LOCAL):
            return
        if not re.fullmatch(r"\S+:\d+", self.coordinator):
            raise ValueError(f"distributed.coordinator: expected HOST:PORT, auto or local, got {self.coordinator!r}")
        if self.processes is None or self.process is None:
            key = "processes" if self.processes is None else "process"
            raise ValueError(f"distributed.{key}: expected a number with distributed.coordinator")
        if not 0 <= self.process < self.processes:
            raise ValueError(f"distributed.process: expected 0 to {self.processes - 1}, got {self.process}")


class ProcessGroup:
    """A process's view of the processes that train together; `join` creates it.

    Attributes:
      index: number of this process.
      signals: signals that this process received; in the first process, those of all processes.
    """

    def __init__(self, index: int, others: LocalProcesses | None = None):
        """Starts to watch for announcements.

        Args:
          index: number of this process.
          others: the processes that this process started.
        """
        self.index = index
        self._others = others
        self.signals = Signals()
        self._client = compat.coordination_client()
        self._left = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="group", daemon=True)
        self._watcher.start()
        EXIT_HOOKS.append(self._announce)
        atexit.register(self.end, _FAILED)

    @property
    def first(self) -> bool:
        """Whether this is the first process, which evaluates and writes."""
        return self.index == 0

    def end(self, exit_code: int) -> None:
        """Ends the other processes with an exit code, and disconnects; further calls do nothing."""
        if self._left.is_set():
            return
        self._left.set()
        self._watcher.join()
        self._end_if_one_is_lost()
        self._announce(exit_code)
        _disconnect()

    def wait(self) -> None:
        """Waits until another process ends this one."""
        self._watcher.join()

    def run(self, work: Callable[[], int | None]) -> int | None:
        """Does the work of this process; ends it with one line if that fails because another process was lost."""
        try:
            return work()
        except jax.errors.JaxRuntimeError as error:
            if not _CONNECTION_ERROR.search(str(error)):
                raise
            self._left.wait(_GRACE_S)  # `_watch` ends this process, if it knows which one was lost
            reason = " ".join(str(error).split())[:200]
            print(f"error: another process of the training is lost: {reason}", file=sys.stderr)
            self._announce(_FAILED)
            _exit(_FAILED)

    def _announce(self, exit_code: int) -> None:
        """Announces that this process has ended, and so all end."""
        with contextlib.suppress(jax.errors.JaxRuntimeError):  # another process has announced the end
            self._client.key_value_set(_ENDED, f"{self.index} {exit_code}")

    def _watch(self) -> None:
        signal_shared = False
        while not self._left.wait(_POLL_S):
            if self.first and not signal_shared and (number := self._read(_SIGNAL)):
                self.signals.caught.append(int(number))
                signal_shared = True
            elif not self.first and not signal_shared and self.signals.caught:
                with contextlib.suppress(jax.errors.JaxRuntimeError):
                    self._client.key_value_set(_SIGNAL, str(self.signals.caught[0]))
                signal_shared = True
            # This thread ends the process, because the main thread may wait in an all-reduce that never ends.
            if ended := self._read(_ENDED):
                process, exit_code = map(int, ended.split())
                if 0 < exit_code < STOPPED_BY_SIGNAL:
                    if self._others and self._left.wait(_GRACE_S):
                        return  # the same error occurred here and has been reported
                    _report(process, self._others)
                _disconnect()
                if self._others:
                    self._others.end()
                _exit(exit_code)
            self._end_if_one_is_lost()

    def _end_if_one_is_lost(self) -> None:
        """Ends all if a process that this one started has ended: JAX would wait for it."""
        if self._others and (ended := self._others.first_ended()):
            _report(ended, self._others)
            self._others.end(patience_s=0)
            _exit(_FAILED)

    def _read(self, key: str) -> str:
        """An announcement through the coordination service; empty if there is none."""
        try:
            return self._client.key_value_try_get(key)
        except jax.errors.JaxRuntimeError:
            return ""


def join(config: DistributedConfig) -> ProcessGroup | None:
    """Connects to the other processes; must run before JAX starts its backend. Returns None for a single process.

    Raises:
      ValueError: the processes cannot connect.
    """
    if not config.coordinator:
        return None
    jax.config.update("jax_enable_preemption_service", False)  # it would handle SIGTERM, which `Signals` handles
    address, count, index = config.coordinator, config.processes, config.process
    others, options = None, {}
    if address == LOCAL:
        if this := local_process():
            address, count, index, _ = this
        else:
            others = LocalProcesses(count := processes_here(count))
            address, index = others.address, 0
            if ended := others.ended_at_start():
                _report(ended, others)
                others.end(patience_s=0)
                _exit(_FAILED)
        options = {"local_device_ids": [index], "coordinator_bind_address": address}
    try:
        jax.distributed.initialize(
            None if address == AUTO else address,
            count,
            index,
            heartbeat_timeout_seconds=_HEARTBEAT_S,
            shutdown_timeout_seconds=_SHUTDOWN_S,
            **options,
        )
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"distributed.coordinator={config.coordinator}: no processes found: {reason}") from error
    return ProcessGroup(compat.process_number(), others)


def processes_here(requested: int | None) -> int:
    """The number of processes on this host; if it has GPUs, each process has one of them.

    Args:
      requested: the config's number; None for one process on each GPU.

    Raises:
      ValueError: more processes than GPUs, or neither GPUs nor a number.
    """
    available = 0 if os.environ.get("JAX_PLATFORMS") == "cpu" else gpu_count()
    if not (requested or available):
        raise ValueError("distributed.processes: expected a number with distributed.coordinator=local without GPUs")
    if available and requested and requested > available:
        raise ValueError(f"distributed.processes: expected at most {available}, a GPU for each, got {requested}")
    return requested or available


def _report(failed: int, others: LocalProcesses | None) -> None:
    """Prints which process failed, and its error output."""
    print(f"error: process {failed} of the training failed", file=sys.stderr)
    if others and failed and (output := others.error_output(failed)):
        print(output, file=sys.stderr)


def _exit(exit_code: int) -> NoReturn:
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(exit_code)


def _disconnect() -> None:
    with contextlib.suppress(jax.errors.JaxRuntimeError):  # the timeout of a process that has ended already
        jax.distributed.shutdown()
