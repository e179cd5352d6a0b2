"""Ctrl-C and SIGTERM while a run goes on: noted, and acted on after the next checkpoint."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

STOPPED_BY_SIGNAL = 128  # plus the signal's number: the exit code by convention


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

    def check(self) -> None:
        """Raises `Interrupted` if one came."""
        if self.caught:
            raise Interrupted(self.caught[0])


@contextmanager
def noted_signals(signals: Signals) -> Iterator[None]:
    """Notes SIGINT and SIGTERM instead of acting on them; a second one of a kind acts at once."""
    previous: dict[int, Any] = {}

    def note(number: int, _: FrameType | None) -> None:
        signals.caught.append(number)
        print("stopping at the next checkpoint; again to stop at once", file=sys.stderr, flush=True)
        signal.signal(number, previous[number] or signal.SIG_DFL)

    for number in (signal.SIGINT, signal.SIGTERM):
        previous[number] = signal.signal(number, note)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler or signal.SIG_DFL)
