"""Ctrl-C, SIGTERM and SIGUSR2 during a run: they are noted, and stop the run after the next checkpoint."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

STOPPED_BY_SIGNAL = 128  # plus the signal's number: the conventional exit code
NOTED = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)  # submitit lets Slurm send SIGUSR2 before a time limit
_NOTICE = "stopping at the next checkpoint; repeat to stop immediately"


class Interrupted(Exception):
    """Training was stopped by a signal after a checkpoint was written."""

    def __init__(self, signal_number: int):
        super().__init__(signal.Signals(signal_number).name)
        self.exit_code = STOPPED_BY_SIGNAL + signal_number


class Signals:
    """The signals that a process received.

    Attributes:
      caught: their numbers, in order.
    """

    def __init__(self) -> None:
        self.caught: list[int] = []

    @property
    def exit_code(self) -> int:
        """The exit code after the first signal; 0 without signals."""
        return STOPPED_BY_SIGNAL + self.caught[0] if self.caught else 0

    def check(self) -> None:
        """Raises `Interrupted` if a signal was received."""
        if self.caught:
            raise Interrupted(self.caught[0])


@contextmanager
def noted_signals(signals: Signals, notice: str = _NOTICE) -> Iterator[None]:
    """Context in which a signal is noted and a notice printed; the same signal again has its usual effect."""
    previous: dict[int, Any] = {}

    def note(number: int, _: FrameType | None) -> None:
        signals.caught.append(number)
        print(notice, file=sys.stderr, flush=True)
        signal.signal(number, previous[number] or signal.SIG_DFL)

    for number in NOTED:
        previous[number] = signal.signal(number, note)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler or signal.SIG_DFL)
