"""Training processes on one host, one for each GPU: the first process starts the others."""

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

_VARIABLE = "MIMIC_LOCAL_PROCESS"  # environment variable with the `LocalProcess` of a started process
_PATIENCE_S = 5  # time for the processes to end by themselves
_EXIT_S = 1  # maximum time between the end of a process's pipe and its exit code
_OUTPUT_BYTES = 2000  # of the error output of a process in a message
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of Linux's prctl


class LocalProcess(NamedTuple):
    """The place of a started process among the training processes.

    Attributes:
      address: HOST:PORT where all processes connect.
      count: number of processes.
      index: number of this process.
      first_pid: process ID of the first process.
    """

    address: str
    count: int
    index: int
    first_pid: int


class LocalProcesses:
    """Processes with the same command as this one.

    Attributes:
      address: HOST:PORT where all processes connect.
    """

    def __init__(self, count: int):
        """Starts the processes.

        Args:
          count: number of processes, including this one, which is number 0.
        """
        self.address = f"127.0.0.1:{_free_port()}"
        self._processes: list[subprocess.Popen[bytes]] = []
        self._stderr: list[IO[bytes]] = []
        atexit.register(self.end)
        for index in range(1, count):
            self._stderr.append(tempfile.TemporaryFile())  # noqa: SIM115 (as long as the process)
            value = " ".join(map(str, LocalProcess(self.address, count, index, os.getpid())))
            process = subprocess.Popen(
                [sys.executable, *sys.orig_argv[1:]],
                env={**os.environ, _VARIABLE: value},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,  # `local_process` writes to it and closes it
                bufsize=0,
                stderr=self._stderr[-1],
                start_new_session=True,  # Ctrl-C reaches only the first process, which announces it
            )
            self._processes.append(process)

    def ended_at_start(self) -> int | None:
        """Waits until all processes run `local_process`; the number of one that ended before, or None."""
        for index, process in enumerate(self._processes, 1):
            if not process.stdout.read(1):  # type: ignore[union-attr]
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_EXIT_S)
                return index
        return None

    def error_output(self, index: int) -> str:
        """The end of a process's stderr, and the signal that ended the process if there was one."""
        code = self._processes[index - 1].poll()  # before reading, so that the output of an ended process is complete
        file = self._stderr[index - 1].fileno()  # shared with the process, which may still write
        start = max(0, os.fstat(file).st_size - _OUTPUT_BYTES)
        output = os.pread(file, _OUTPUT_BYTES, start).decode(errors="replace").strip()
        ended = f"ended by signal {-code} ({signal.strsignal(-code)})" if code is not None and code < 0 else ""
        return "\n".join(filter(None, [output, ended]))

    def first_ended(self) -> int | None:
        """The number of the first process that has ended; None while all run."""
        return next((index for index, process in enumerate(self._processes, 1) if process.poll() is not None), None)

    def end(self, patience_s: float = _PATIENCE_S) -> None:
        """Waits for the processes, and kills those that do not end."""
        until = time.monotonic() + patience_s
        for process in self._processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(0, until - time.monotonic()))
            process.kill()
            process.wait()


def local_process() -> LocalProcess | None:
    """The place of this process, which then ends with the first process; None if this is the first process."""
    if _VARIABLE not in os.environ:
        return None
    address, *numbers = os.environ.pop(_VARIABLE).split()
    this = LocalProcess(address, *map(int, numbers))
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != this.first_pid:
        sys.exit(1)
    os.write(1, b".")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return this


def gpu_count() -> int:
    """The number of NVIDIA GPUs that a process of this host can use, without starting any."""
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
