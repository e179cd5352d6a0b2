"""Training spread over several processes: they find each other, train in step, and end together.

The first process alone writes, evaluates and may stop early, while the others wait in their next training program for
it. So the end of a training is told to them beside the programs, through JAX's coordination service; a failure, or a
signal that only one of them got, is told in the same way.
"""

import atexit
import contextlib
import dataclasses
import os
import re
import sys
import threading

import jax

from mimic import compat
from mimic.runs.signals import STOPPED_BY_SIGNAL, Signals
from mimic.trainers.distributed.local_processes import LocalProcesses, gpus, told

AUTO, LOCAL = "auto", "local"
_ENDED, _SIGNAL = "mimic/ended", "mimic/signal"  # keys of the coordination service
_LOOK_S = 0.5
_LEAVE_S = 60  # the last process to leave is waited for this long
_GRACE_S = 3  # a process may fail of what another failed of, this much later
_FAILED = 1


@dataclasses.dataclass(frozen=True)
class DistributedConfig:
    """The processes that train together; each is started with the same command, but for its number.

    Attributes:
      coordinator: HOST:PORT of the first process, where all find each other; "auto" under Slurm and Open MPI, which
        tell everything; "local" for processes on this host, which the first starts; one process alone where empty.
      processes: how many; with "local" one for each GPU where None.
      process: number of this one; the first, 0, evaluates and writes the run directory.
    """

    coordinator: str = ""
    processes: int | None = None
    process: int | None = None

    def __post_init__(self) -> None:
        given = {"processes": self.processes, "process": self.process}
        takes = {"": (), AUTO: (), LOCAL: ("processes",)}.get(self.coordinator, tuple(given))
        for key, value in given.items():
            if value is not None and key not in takes:
                raise ValueError(
                    f"distributed.{key}: not expected, got {value} with distributed.coordinator={self.coordinator!r}"
                )
        if self.processes is not None and self.processes < 1:
            raise ValueError(f"distributed.processes: expected at least 1, got {self.processes}")
        if self.coordinator in ("", AUTO, LOCAL):
            return
        if not re.fullmatch(r"\S+:\d+", self.coordinator):
            raise ValueError(f"distributed.coordinator: expected HOST:PORT, auto or local, got {self.coordinator!r}")
        for key, value in given.items():
            if value is None:
                raise ValueError(f"distributed.{key}: expected a number besides distributed.coordinator")
        if not 0 <= self.process < self.processes:  # type: ignore[operator]
            raise ValueError(f"distributed.process: expected 0 to {self.processes - 1}, got {self.process}")  # type: ignore[operator]


class ProcessGroup:
    """The processes that train together, as one of them sees them; made by `join`.

    Attributes:
      index: number of this process.
      signals: what this process was sent; the first process gets the others' too.
    """

    def __init__(self, index: int, others: LocalProcesses | None = None):
        """Watches over the others.

        Args:
          index: number of this process.
          others: those that this process started.
        """
        self.index = index
        self._others = others
        self.signals = Signals()
        self._client = compat.coordination_client()
        self._left = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="group", daemon=True)
        self._watcher.start()
        atexit.register(self.end, _FAILED)

    @property
    def first(self) -> bool:
        """Whether this process evaluates and writes."""
        return self.index == 0

    def end(self, exit_code: int) -> None:
        """Ends the other processes with an exit code, and goes on alone; nothing if that was done before."""
        if self._left.is_set():
            return
        self._left.set()
        self._watcher.join()
        self._end_if_one_is_lost()
        with contextlib.suppress(jax.errors.JaxRuntimeError):  # another process was faster
            self._client.key_value_set(_ENDED, f"{self.index} {exit_code}")
        _leave()

    def wait(self) -> None:
        """Until another process ends this one."""
        self._watcher.join()

    def _watch(self) -> None:
        told = False
        while not self._left.wait(_LOOK_S):
            if self.first and not told and (sent := self._read(_SIGNAL)):
                self.signals.caught.append(int(sent))
                told = True
            elif not self.first and not told and self.signals.caught:
                with contextlib.suppress(jax.errors.JaxRuntimeError):
                    self._client.key_value_set(_SIGNAL, str(self.signals.caught[0]))
                told = True
            # The main thread may wait in a program that will never end.
            if ended := self._read(_ENDED):
                process, exit_code = map(int, ended.split())
                if 0 < exit_code < STOPPED_BY_SIGNAL:
                    if self._others and self._left.wait(_GRACE_S):
                        return  # what failed there failed here too, and was said
                    _report(process, self._others)
                _leave()
                if self._others:
                    self._others.end()
                _exit(exit_code)
            self._end_if_one_is_lost()

    def _end_if_one_is_lost(self) -> None:
        """Of those that this process started: JAX would wait for it."""
        if self._others and (gone := self._others.gone()):
            _report(gone, self._others)
            self._others.end(patience_s=0)
            _exit(_FAILED)

    def _read(self, key: str) -> str:
        """What the processes were told; nothing where they were not."""
        try:
            return self._client.key_value_try_get(key)
        except jax.errors.JaxRuntimeError:
            return ""


def join(config: DistributedConfig) -> ProcessGroup | None:
    """Waits for the other processes; must run before JAX starts its backend. None where this process is alone.

    Raises:
      ValueError: they cannot be found.
    """
    if not config.coordinator:
        return None
    jax.config.update("jax_enable_preemption_service", False)  # would take SIGTERM, which is ours
    address, count, index = config.coordinator, config.processes, config.process
    others, how = None, {}
    if address == LOCAL:
        if this := told():
            address, count, index, _ = this
        else:
            others = LocalProcesses(count := processes_here(count))
            address, index = others.address, 0
            if lost := others.lost_at_start():
                _report(lost, others)
                others.end(patience_s=0)
                _exit(_FAILED)
        how = {"local_device_ids": [index], "coordinator_bind_address": address}
    try:
        jax.distributed.initialize(
            None if address == AUTO else address, count, index, shutdown_timeout_seconds=_LEAVE_S, **how
        )
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"distributed.coordinator={config.coordinator}: no processes found: {reason}") from error
    return ProcessGroup(compat.process_number(), others)


def processes_here(asked: int | None) -> int:
    """How many processes train on this host, with a GPU for each where there are GPUs.

    Raises:
      ValueError: more than there are GPUs, or neither GPUs nor a number.
    """
    available = 0 if os.environ.get("JAX_PLATFORMS") == "cpu" else gpus()
    if not (asked or available):
        raise ValueError("distributed.processes: expected a number with distributed.coordinator=local without GPUs")
    if available and asked and asked > available:
        raise ValueError(f"distributed.processes: expected at most {available}, a GPU for each, got {asked}")
    return asked or available


def _report(failed: int, others: LocalProcesses | None) -> None:
    """Says which process failed, and what it said of it itself."""
    print(f"error: process {failed} of the training failed", file=sys.stderr)
    if others and failed and (said := others.said(failed)):
        print(said, file=sys.stderr)


def _exit(exit_code: int) -> None:
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(exit_code)


def _leave() -> None:
    with contextlib.suppress(jax.errors.JaxRuntimeError):  # one that is gone already is waited for in vain
        jax.distributed.shutdown()
