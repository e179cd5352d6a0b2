"""The other processes of a training on this host, which the first starts: one for each GPU."""

import atexit
import contextlib
import ctypes
import os
import socket
import subprocess
import sys
import tempfile
from typing import IO

_LEAVE_S = 5  # they are given this long to end by themselves


class LocalProcesses:
    """Copies of this process, each with the GPU of its number; where there is none, with the processor.

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
            found = f"coordinator={self.address}", f"processes={count}", f"process={index}"
            process = subprocess.Popen(
                [sys.executable, *sys.orig_argv[1:], *(f"distributed.{setting}" for setting in found)],
                env={**os.environ, "JAX_LOCAL_DEVICE_IDS": str(index)},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._stderr[-1],
                start_new_session=True,  # Ctrl-C goes to the first alone, which tells them
            )
            self._processes.append(process)

    def said(self, index: int) -> str:
        """What one of them wrote to stderr, the end of it."""
        file = self._stderr[index - 1]
        file.seek(0)
        return file.read().decode(errors="replace")[-2000:].strip()

    def gone(self) -> int | None:
        """Number of one that has ended; None where all go on."""
        return next((index for index, process in enumerate(self._processes, 1) if process.poll() is not None), None)

    def end(self, patience_s: float = _LEAVE_S) -> None:
        """Waits for them, and kills those that do not end."""
        for process in self._processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(patience_s)
            process.kill()
            process.wait()


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
