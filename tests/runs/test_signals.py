"""Signals: one line and the right exit code at any moment, and a second one that stops immediately."""

import os
import pathlib
import pty
import signal
import subprocess
import sys
import time

import pytest

from mimic.runs import signals
from mimic.runs.signals import EXIT_HOOKS, Signals, exit_hook, is_repeat, noted_signals, runs_as_command
from tests.helpers.commands import wait_for
from tests.helpers.repository import REPOSITORY

INT, TERM, USR2 = signal.SIGINT, signal.SIGTERM, signal.SIGUSR2
LATEST_S = 60  # for anything, on a busy machine


@pytest.fixture
def start(tmp_path):
    """Starts a program, with its lines of output as they come; kills it at the end."""
    started = []

    def run(*arguments, **options):
        output = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **options}
        folders = REPOSITORY, REPOSITORY / "mimic" / "runs"  # the programs import the module alone, which is fast
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders)), "PYTHONUNBUFFERED": "1"}
        started.append(subprocess.Popen([sys.executable, *arguments], cwd=tmp_path, env=environment, **output))
        return started[-1]

    yield run
    for process in started:
        process.kill()
        process.communicate()


def wait_until_watching(process):
    """Waits until a process handles signals: the first thing that a command does."""
    until = time.monotonic() + LATEST_S
    while time.monotonic() < until:
        lines = pathlib.Path(f"/proc/{process.pid}/status").read_text().splitlines()
        caught = int(next(line for line in lines if line.startswith("SigCgt")).split()[1], 16)
        if caught & (1 << (USR2 - 1)):
            return
        time.sleep(0.005)
    raise AssertionError("the process does not handle signals")


@pytest.mark.parametrize("number", signals.NOTED, ids=lambda number: number.name)
def test_a_command_that_imports_ends_in_one_line(start, number, tmp_path):
    process = start("-m", "mimic.train", "run_dir=run")
    wait_until_watching(process)
    process.send_signal(number)
    assert process.communicate(timeout=LATEST_S) == ("", f"stopped by {number.name}\n")
    assert process.returncode == 128 + number and not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [("-m", "mimic"), ("-u", "-m", "mimic.inspect", "--help")])
def test_a_command_whose_output_nobody_reads_ends_silently(arguments):
    """Python writes its output at the end, or with -u as it is printed."""
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run([sys.executable, *arguments], stdout=write, stderr=subprocess.PIPE, timeout=LATEST_S)
    os.close(write)
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGPIPE, b"")


def test_importing_the_library_leaves_signals_alone():
    assert "mimic" in sys.modules and signal.getsignal(USR2) == signal.SIG_DFL


# The main thread computes without ever running Python, as in a compilation.
BUSY = """
import hashlib
from signals import Signals, exit_hook, noted_signals
with noted_signals(Signals(), "noted"), exit_hook(lambda code: print("hook", code)):
    print("ready")
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)
"""


@pytest.mark.parametrize(("first", "second"), [(TERM, TERM), (USR2, INT)])
def test_a_second_signal_stops_immediately_while_the_main_thread_computes(start, first, second):
    process = start("-c", BUSY)
    assert process.stdout.readline() == "ready\n"
    process.send_signal(first)
    assert process.stderr.readline() == "noted\n"
    time.sleep(0.3)
    process.send_signal(second)
    assert process.communicate(timeout=20) == (f"hook {128 + second}\n", f"stopped by {second.name}\n")
    assert process.returncode == 128 + second


@pytest.mark.parametrize(
    ("first", "second", "after", "expected"),
    [
        (INT, INT, 0.3, True),
        (TERM, TERM, 0.3, True),
        (TERM, INT, 0.3, True),
        (INT, TERM, 0.3, True),
        (INT, INT, 0.05, False),  # from the terminal and from the parent
        (TERM, TERM, 0.05, False),  # from Slurm and from the parent
        (USR2, TERM, 60.0, False),  # Slurm's warning, then its time limit
    ],
)
def test_which_signal_is_a_repeat(first, second, after, expected):
    assert is_repeat((first, 5.0), (second, 5.0 + after)) == expected


NOTED = """
import pathlib, time
from signals import Signals, noted_signals
signals = Signals()
with noted_signals(signals):
    pathlib.Path("ready").touch()
    for _ in range(600):
        if signals.caught:
            print("the line that a terminal that has closed does not take")
            pathlib.Path("kept").touch()
            raise SystemExit(signals.exit_code)
        time.sleep(0.1)
"""


def test_a_terminal_that_closes_leaves_what_there_is_to_keep(start, tmp_path):
    terminal, end = pty.openpty()

    def take_terminal():
        import fcntl
        import termios

        os.setsid()
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    process = start("-c", NOTED, stdin=end, stdout=end, stderr=end, preexec_fn=take_terminal)
    os.close(end)
    wait_for(tmp_path, "ready", process)
    os.close(terminal)
    assert process.wait(LATEST_S) == 128 + signal.SIGHUP and (tmp_path / "kept").exists()


def test_nohup_keeps_a_command(start, tmp_path):
    process = start("-c", NOTED, preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN))
    wait_for(tmp_path, "ready", process)
    process.send_signal(signal.SIGHUP)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=LATEST_S)
    assert process.returncode == 128 + signal.SIGTERM


def test_a_signal_is_noted_and_the_handlers_are_restored(capsys):
    previous = {number: signal.getsignal(number) for number in signals.NOTED}
    received = Signals()
    with noted_signals(received, "noted"):
        os.kill(os.getpid(), TERM)
        until = time.monotonic() + LATEST_S
        while not received.caught and time.monotonic() < until:
            time.sleep(0.01)
        time.sleep(0.1)
    assert received.caught == [TERM] and received.exit_code == 143
    assert capsys.readouterr().err == "noted\n"
    assert {number: signal.getsignal(number) for number in signals.NOTED} == previous
    with pytest.raises(signals.Interrupted, match="SIGTERM"):
        received.check()


def test_exit_hooks_are_removed():
    with exit_hook(hook := lambda _: None):
        assert EXIT_HOOKS[-1] is hook
    assert hook not in EXIT_HOOKS


@pytest.mark.parametrize(
    ("argv", "original", "expected"),
    [
        (["-m", "seed=1"], ["python", "-m", "mimic.train", "seed=1"], True),
        (["-m"], ["python", "-X", "dev", "-mmimic.view"], True),
        (["-m"], ["python", "-m", "mimic"], True),
        (["-m", "mimic.x"], ["python", "-m", "pytest", "mimic.x"], False),
        (["-m"], ["python", "-m", "mimicry.train"], False),
        (["train.py"], ["python", "train.py"], False),
        (["-c"], ["python", "-c", "import mimic.train"], False),
        ([], ["python"], False),
    ],
)
def test_a_command_is_recognised(monkeypatch, argv, original, expected):
    monkeypatch.setattr(sys, "argv", argv)
    monkeypatch.setattr(sys, "orig_argv", original)
    assert runs_as_command() == expected
