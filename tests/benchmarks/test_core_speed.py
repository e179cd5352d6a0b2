"""The speed of a core over time: of samples that are known, and of the process that measures it."""

import os
import pathlib
import subprocess
import sys
import time

import numpy as np
import pytest

from benchmarks.common.core_speed import is_full_speed, loop_durations, measured_speed, shortest_loop

linux = pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="needs Linux")


def test_the_longer_of_the_samples_around_a_time_counts():
    samples = [(1.0, 5e-6), (2.0, 9e-6), (3.0, 5.1e-6), (4.0, 5.2e-6)]
    durations = loop_durations(samples, np.array([0.5, 1.5, 2.5, 3.5, 9.0]))
    np.testing.assert_array_equal(durations, [9e-6, 9e-6, 9e-6, 5.2e-6, 5.2e-6])
    assert abs(shortest_loop(samples) - 5e-6) < 1e-8
    np.testing.assert_array_equal(is_full_speed(durations, 5e-6), [False, False, False, True, True])
    assert not is_full_speed(durations, 4e-6).any()


def children():
    return set(map(int, pathlib.Path("/proc/thread-self/children").read_text().split()))


@linux
def test_a_process_of_the_lowest_priority_times_a_loop_until_the_context_ends():
    core, before, start = max(os.sched_getaffinity(0)), children(), time.perf_counter()
    with measured_speed(core) as samples:
        (child,) = children() - before
        assert os.sched_getscheduler(child) == os.SCHED_IDLE and os.sched_getaffinity(child) == {core}
        time.sleep(0.5)
    assert children() == before
    at, seconds = np.array(samples).T
    assert np.all(np.diff(at) > 0.004) and start < at[0] and at[-1] < time.perf_counter()
    assert 1e-7 < seconds.min() < at[-1] - start  # on a busy core there may be only one
    with measured_speed(None) as samples:
        assert children() == before and not samples


@linux
def test_the_process_ends_with_its_parent():
    code = """
import os, pathlib
from benchmarks.common.core_speed import measured_speed
with measured_speed(max(os.sched_getaffinity(0))):
    print(pathlib.Path("/proc/thread-self/children").read_text(), flush=True)
    os._exit(1)
"""
    text = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=False).stdout
    child, end = pathlib.Path("/proc", text.strip()), time.monotonic() + 60
    while child.exists() and time.monotonic() < end:
        time.sleep(0.05)
    assert text.strip().isdigit() and not child.exists()
