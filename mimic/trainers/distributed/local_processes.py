"""The other processes of a training on this host, which the first starts: one for each GPU."""

import atexit
import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from typing import IO, NamedTuple

_TOLD = "MIMIC_LOCAL_PROCESS"  # variable by which a process is told who it is
_PATIENCE_S = 5  # they are given this long to end by themselves
_DYING_S = 1  # between the end of its pipe and its exit code
_SHOWN = 2000  # bytes of what one of them said
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of Linux's prctl


class Told(NamedTuple):
    """What the first process tells another.

    Attributes:
      address: HOST:PORT where all find each other.
      count: of processes.
      index: of this one.
      first: the first one's process number in the system.
    """

    address: str
    count: int
    index: int
    first: int


class LocalProcesses:
    """Copies of this process.

    Attributes:
      address: HOST:PORT where all find each other.
    """

    def __init__(self, count: int):
        """Starts them.

        Args:
          count: of processes, this one included, which is number 0.
        """
        self.address = f"127.0.0.1:{_free_port()}"
        self._processes: list[subprocess.Popen[bytes]] = []
        self._stderr: list[IO[bytes]] = []
        atexit.register(self.end)
        for index in range(1, count):
            self._stderr.append(tempfile.TemporaryFile())  # noqa: SIM115 (as long as the process)
            told = " ".join(map(str, Told(self.address, count, index, os.getpid())))
            process = subprocess.Popen(
                [sys.executable, *sys.orig_argv[1:]],
                env={**os.environ, _TOLD: told},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,  # closed by `told`, which says with it that it got that far
                bufsize=0,
                stderr=self._stderr[-1],
                start_new_session=True,  # Ctrl-C goes to the first alone, which tells them
            )
            self._processes.append(process)

    def lost_at_start(self) -> int | None:
        """Waits until all look for each other; number of one that ended before, None where all do."""
        for index, process in enumerate(self._processes, 1):
            if not process.stdout.read(1):  # type: ignore[union-attr]
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_DYING_S)
                return index
        return None

    def said(self, index: int) -> str:
        """What one of them wrote to stderr, the end of it, and which signal ended it if one did."""
        code = self._processes[index - 1].poll()  # before what it wrote, which is all of it then
        file = self._stderr[index - 1].fileno()  # shared with the process, which may still write
        start = max(0, os.fstat(file).st_size - _SHOWN)
        wrote = os.pread(file, _SHOWN, start).decode(errors="replace").strip()
        ended = f"ended by signal {-code} ({signal.strsignal(-code)})" if code is not None and code < 0 else ""
        return "\n".join(filter(None, [wrote, ended]))

    def gone(self) -> int | None:
        """Number of one that has ended; None where all go on."""
        return next((index for index, process in enumerate(self._processes, 1) if process.poll() is not None), None)

    def end(self, patience_s: float = _PATIENCE_S) -> None:
        """Waits for them, and kills those that do not end."""
        until = time.monotonic() + patience_s
        for process in self._processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(0, until - time.monotonic()))
            process.kill()
            process.wait()


def told() -> Told | None:
    """Who this process is, if another one started it, and it ends with that; None where it is the first."""
    if _TOLD not in os.environ:
        return None
    address, *numbers = os.environ.pop(_TOLD).split()
    this = Told(address, *map(int, numbers))
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != this.first:
        sys.exit(1)
    os.write(1, b".")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return this


def gpus() -> int:
    """NVIDIA GPUs that a process of this host would see, of which none is touched."""
    try:
        cuda = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return 0
    count = ctypes.c_int()
    failed = cuda.cuInit(0) or cuda.cuDeviceGetCount(ctypes.byref(count))
    return 0 if failed else count.value


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
