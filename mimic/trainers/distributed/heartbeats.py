"""Which of several processes is lost: each sends heartbeats, and one that is silent too long is lost."""

import threading
import time

_LIMIT_S = 30  # longer than a process holds Python's lock, as while JAX traces; all end within twice this time
_CLOSE_S = 5  # processes whose silence began within this time fell silent for one reason
_OWN_PAUSE_S = 5  # a longer time between two calls means that this process itself was stopped, or the machine


class Heartbeats:
    """When each process last sent a heartbeat. The methods are thread-safe.

    Args:
      processes: number of processes.
      limit_s: time after which a silent process counts as lost [s].
    """

    def __init__(self, processes: int, limit_s: float = _LIMIT_S):
        self._limit_s = limit_s
        self._lock = threading.Lock()
        self._checked = time.monotonic()
        self._heard = dict.fromkeys(range(processes), self._checked)
        self._last: dict[int, str] = {}

    def hear(self, process: int, sign: str) -> None:
        """Records the latest heartbeat of a process; it lives if that differs from the one before."""
        with self._lock:
            if self._last.get(process) != sign:
                self._last[process], self._heard[process] = sign, time.monotonic()

    def lost(self) -> tuple[int, float] | None:
        """A lost process and the time since its last heartbeat [s]; None while all live.

        If the first process is stopped, nothing is heard of any, so that of several it is the first one that is named.
        """
        now = time.monotonic()
        with self._lock:
            pause, self._checked = now - self._checked, now
            if pause > _OWN_PAUSE_S:
                self._heard = {process: heard + pause for process, heard in self._heard.items()}
            since = min(self._heard.values())
            if now - since <= self._limit_s:
                return None
            return min(process for process, heard in self._heard.items() if heard < since + _CLOSE_S), now - since
