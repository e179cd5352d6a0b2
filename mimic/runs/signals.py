"""Signals that end a command: a thread receives them, also while the main thread imports, compiles or computes.

The first signal stops a command immediately, or where there is something to keep (`noted_signals`), after the next
checkpoint. The second one always stops it immediately. Files have their final names only when they are complete, so
that this is possible at any moment. Imports nothing heavy, because `mimic` imports it first.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

STOPPED_BY_SIGNAL = 128  # plus the signal's number: the conventional exit code
_SIGPIPE = 13  # which Python ignores, and Windows lacks
# Slurm and submitit send SIGUSR1 or SIGUSR2 before a time limit; a terminal that closes sends SIGHUP.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2")
NOTED = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
_NOTICE = "stopping at the next checkpoint; repeat to stop immediately"
_DUPLICATE_S = 0.2  # repeated within this time, a signal came on two ways: from Slurm or a shell, and from the parent
_PATIENCE_S = 2  # for output and for the hooks at an exit; a terminal may be blocked, another process stopped
_END = b"\0"  # ends the thread; not the number of a signal
_SHOW_CURSOR = b"\x1b[?25h"  # progress bars hide it

# Called with the exit code before a signal stops this process immediately: they stop its children.
EXIT_HOOKS: list[Callable[[int], None]] = []


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


class _Watch:
    """Receives the signals of this process in a thread, through the file that Python's signal handler writes to.

    Handlers in Python would run in the main thread, and wait there for the end of a compilation.
    """

    def __init__(self) -> None:
        self.noting: list[Callable[[int], None]] = []  # the last one receives the first signal
        self._first: tuple[int, float] | None = None  # number and time of the first signal
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        ignored = [number for number in NOTED if number == _hangup() and signal.getsignal(number) == signal.SIG_IGN]
        numbers = [number for number in NOTED if number not in ignored]  # nohup ignores SIGHUP
        self._thread = threading.Thread(target=self._run, daemon=True, name="signals")
        self._thread.start()
        self._previous_file = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._previous: dict[int, Any] = {number: signal.signal(number, lambda *_: None) for number in numbers}

    def stop(self) -> None:
        """Restores the handlers."""
        for number, handler in self._previous.items():
            signal.signal(number, handler or signal.SIG_DFL)
        signal.set_wakeup_fd(self._previous_file)
        os.write(self._write, _END)
        self._thread.join()
        os.close(self._read)
        os.close(self._write)

    def _run(self) -> None:
        while (byte := os.read(self._read, 1)) and byte != _END:
            if byte[0] in NOTED:
                self._receive(byte[0])

    def _receive(self, number: int) -> None:
        if number == _hangup():
            _replace_lost_terminal()
        now = time.monotonic()
        if self._first is None:
            self._first = number, now
            if not self.noting:
                _exit(number)
            self.noting[-1](number)
        elif is_repeat(self._first, (number, now)):
            _exit(number)


def is_repeat(first: tuple[int, float], second: tuple[int, float]) -> bool:
    """Whether a signal asks to stop immediately; each has its number and time [s].

    It does where it is the same as the first, or where one of them came from a keyboard. Slurm sends different ones.
    """
    return second[1] - first[1] > _DUPLICATE_S and (second[0] == first[0] or signal.SIGINT in (first[0], second[0]))


_watch: _Watch | None = None  # of this process


def watch_signals() -> None:
    """Receives signals from now to the end of the process."""
    global _watch
    if _watch is None and threading.current_thread() is threading.main_thread():
        _watch = _Watch()


@contextmanager
def watched_signals() -> Iterator[None]:
    """Context in which signals are received; it changes nothing where they are received already."""
    global _watch
    if _watch is not None or threading.current_thread() is not threading.main_thread():
        yield
        return
    watch_signals()
    try:
        yield
    finally:
        watch, _watch = _watch, None
        if watch is not None:
            watch.stop()


@contextmanager
def noted_signals(signals: Signals, notice: str = _NOTICE) -> Iterator[None]:
    """Context in which the first signal is noted and a notice printed; the second one stops the process."""

    def note(number: int) -> None:
        signals.caught.append(number)
        with_patience(lambda: print(notice, file=sys.stderr, flush=True))

    with watched_signals():
        watch = _watch
        if watch is not None:
            watch.noting.append(note)
        try:
            yield
        finally:
            if watch is not None:
                watch.noting.remove(note)


@contextmanager
def exit_hook(hook: Callable[[int], None]) -> Iterator[None]:
    """Context in which a hook is one of `EXIT_HOOKS`."""
    EXIT_HOOKS.append(hook)
    try:
        yield
    finally:
        EXIT_HOOKS.remove(hook)


@contextmanager
def ended_without_reader() -> Iterator[None]:
    """Context in which a process ends silently, as SIGPIPE would end it, where nobody reads its output: `| head -1`."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except (BrokenPipeError, SystemExit) as error:  # Rich exits with 1
        if not any(isinstance(cause, BrokenPipeError) for cause in (error, error.__context__)):
            raise
        for descriptor in (1, 2):  # what is left is written when Python ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
        sys.exit(STOPPED_BY_SIGNAL + _SIGPIPE)


def runs_as_command() -> bool:
    """Whether this process was started by `mimic` or `python -m mimic.NAME`, and is importing the package of it."""
    if sys.argv[:1] and os.path.basename(sys.argv[0]) == "mimic" and sys.argv[0] in sys.orig_argv[1:2]:
        return True
    if sys.argv[:1] != ["-m"] or len(sys.orig_argv) <= len(sys.argv):
        return False
    return sys.orig_argv[-len(sys.argv)].removeprefix("-m").partition(".")[0] == "mimic"


def _exit(number: int) -> NoReturn:
    """Ends the process: prints one line, and calls the hooks."""
    exit_code = STOPPED_BY_SIGNAL + number

    def finish() -> None:
        for hook in reversed(EXIT_HOOKS):
            with contextlib.suppress(Exception):
                hook(exit_code)
        with contextlib.suppress(OSError, ValueError):
            if os.isatty(1):
                os.write(1, _SHOW_CURSOR)
            sys.stdout.flush()
        with contextlib.suppress(OSError, ValueError):
            print(f"stopped by {signal.Signals(number).name}", file=sys.stderr, flush=True)

    with_patience(finish)
    os._exit(exit_code)


def with_patience(act: Callable[[], None]) -> None:
    """Acts in a thread, and waits for it two seconds: a blocked terminal must not keep a process from ending."""

    def attempt() -> None:
        with contextlib.suppress(OSError, ValueError):
            act()

    thread = threading.Thread(target=attempt, daemon=True)
    thread.start()
    thread.join(_PATIENCE_S)


def _hangup() -> int | None:
    return getattr(signal, "SIGHUP", None)


def _replace_lost_terminal() -> None:
    """Sends output to nowhere if its terminal has closed: to print a line would fail."""
    for descriptor in (1, 2):
        try:
            os.write(descriptor, b"")
        except OSError:
            with contextlib.suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
