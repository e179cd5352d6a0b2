"""Cores of the computer for the inner loop and for the policy, on Linux."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

# Ends with its parent; Ctrl-C in a terminal reaches it too.
_BUSY = """
import os, signal, sys
os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))  # itself, at once: it inherits a real-time priority
signal.signal(signal.SIGINT, signal.SIG_IGN)
while os.getppid() == int(sys.argv[1]):
    for _ in range(10_000):
        pass
"""


def check_core(core: int) -> None:
    """Raises a ValueError for a core that no process can have."""
    if not hasattr(os, "sched_setaffinity"):
        raise ValueError(f"core: expected None where a process cannot choose its core (Linux only), got {core}")
    if core < 0:
        raise ValueError(f"core: expected a number of a core, from 0 on, got {core}")


@contextlib.contextmanager
def awake_core(core: int | None) -> Iterator[None]:
    """Context in which this thread, and what it starts, runs on a core that does not halt; nothing changes for None.

    A core that halts takes time to wake up, and a virtual machine may lose it to another one. So a process of the
    lowest priority keeps it busy. It yields to every other process of its session and control group.

    Raises:
      ValueError: the thread cannot run on this core.
      OSError: a process of the lowest priority is not allowed.
    """
    if core is None:
        yield
        return
    check_core(core)
    cores = os.sched_getaffinity(0)
    if core not in cores:
        raise ValueError(f"core: expected one that this thread may use, of {sorted(cores)}, got {core}")
    try:
        os.sched_setaffinity(0, {core})
        with _busy_process(cores):
            yield
    finally:
        with contextlib.suppress(OSError):  # they are no longer allowed
            os.sched_setaffinity(0, os.sched_getaffinity(0) | cores)


@contextlib.contextmanager
def _busy_process(cores: set[int]) -> Iterator[None]:
    """Context with a busy process of the lowest priority on the core of this thread; it may end on the others."""
    with subprocess.Popen([sys.executable, "-I", "-S", "-c", _BUSY, str(os.getpid())]) as process:
        try:
            os.sched_setscheduler(process.pid, os.SCHED_IDLE, os.sched_param(0))
            yield
        finally:
            with contextlib.suppress(OSError):
                os.sched_setaffinity(process.pid, cores)  # on a busy core it would take long to end
            process.kill()
