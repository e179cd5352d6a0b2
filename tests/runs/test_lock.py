"""The lock of a run directory, against another process."""

import subprocess
import sys

import pytest

from mimic.runs.lock import RunLock

HOLD = """
import sys, time
from pathlib import Path
from mimic.runs.lock import RunLock
lock = RunLock(Path(sys.argv[1]))
print("held", flush=True)
time.sleep(60)
"""


def hold(folder):
    """A process that holds the lock until it is killed."""
    command = [sys.executable, "-c", HOLD, folder]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


def test_one_process_alone_holds_the_lock(tmp_path):
    closed = RunLock(tmp_path)
    closed.close()
    process = hold(tmp_path)  # a closed lock is free
    try:
        with pytest.raises(ValueError, match=rf"is in use by process {process.pid} on \S+ since \d{{4}}-"):
            RunLock(tmp_path)
    finally:
        process.kill()
        process.wait()
    RunLock(tmp_path).close()  # the lock of a process that was killed is free
