"""The lock of a run directory: only one process writes to it."""

import contextlib
import json
import os
import socket
import time
from pathlib import Path

from mimic.base.files import read_json

try:
    import fcntl
except ImportError:  # Windows, where runs are not locked
    fcntl = None

LOCK = ".lock"


class RunLock:
    """Holds the lock of a run directory until it is closed or the process ends, however it ends.

    The kernel holds it, so that no lock is stale. The file has the host, process and time for people.

    Args:
      run_dir: an existing folder.

    Raises:
      ValueError: another process holds the lock.
    """

    def __init__(self, run_dir: Path):
        self._file = (run_dir / LOCK).open("a+")
        if fcntl is None:
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            owner = _owner(run_dir)
            self._file.close()
            raise ValueError(f"run directory {str(run_dir)!r} is in use by {owner}") from error
        except OSError:  # a file system without locks
            return
        owner = {"host": socket.gethostname(), "process": os.getpid(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
        self._file.truncate(0)
        self._file.write(json.dumps(owner))
        self._file.flush()

    def close(self) -> None:
        """Releases the lock."""
        self._file.close()


def _owner(run_dir: Path) -> str:
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
        owner = read_json(run_dir / LOCK)
        return f"process {owner['process']} on {owner['host']} since {owner['since']}"
    return "another process"
