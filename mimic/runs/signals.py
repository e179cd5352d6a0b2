"""Ctrl-C, SIGTERM and SIGUSR2 while a run goes on: noted, and acted on after the next checkpoint."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

STOPPED_BY_SIGNAL = 128  # plus the signal's number: the exit code by convention
NOTED = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)  # the last is how submitit has Slurm warn of a time limit
_NOTICE = "stopping at the next checkpoint; again to stop at once"


class Interrupted(Exception):
    """Training was stopped by a signal after a checkpoint was written."""

    def __init__(self, signal_number: int):
        super().__init__(signal.Signals(signal_number).name)
        self.exit_code = STOPPED_BY_SIGNAL + signal_number


class Signals:
    """The signals that came.

    Attributes:
      caught: their numbers, in order.
    """

    def __init__(self) -> None:
        self.caught: list[int] = []

    @property
    def exit_code(self) -> int:
        """Of a process that the first of them ended; 0 if none came."""
        return STOPPED_BY_SIGNAL + self.caught[0] if self.caught else 0

    def check(self) -> None:
        """Raises `Interrupted` if one came."""
        if self.caught:
            raise Interrupted(self.caught[0])


@contextmanager
def noted_signals(signals: Signals, notice: str = _NOTICE) -> Iterator[None]:
    """Notes signals instead of acting on them, and prints what follows; a second one of a kind acts at once."""
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
