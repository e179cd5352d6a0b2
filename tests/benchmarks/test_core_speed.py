"""The speed of cores over time: of samples that are known, and of a core that another process shares."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from benchmarks.common.core_speed import is_full_speed, loop_durations, measured_speeds


def test_the_longer_of_the_samples_around_a_time_counts():
    samples = [(1.0, 5e-6), (2.0, 9e-6), (3.0, 5.1e-6), (4.0, 5.2e-6)]
    durations = loop_durations(samples, np.array([0.5, 1.5, 2.5, 3.5, 9.0]))
    np.testing.assert_array_equal(durations, [9e-6, 9e-6, 9e-6, 5.2e-6, 5.2e-6])
    np.testing.assert_array_equal(is_full_speed(durations), [False, False, False, True, True])


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="needs Linux")
def test_a_process_on_each_core_times_a_loop_until_the_context_ends():
    cores = sorted(os.sched_getaffinity(0))[-2:]
    start = time.perf_counter()
    with measured_speeds(cores) as speeds:
        busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in cores]
        time.sleep(0.5)
        for process in busy:  # the lowest priority must not keep others from their cores
            process.kill()
            process.wait()
        time.sleep(0.5)
        assert not any(speeds.values())
    assert time.perf_counter() - start < 10
    for samples in speeds.values():
        at, seconds = np.array(samples).T
        assert len(at) >= 2 and np.all(np.diff(at) > 0.004) and start < at[0] and at[-1] < time.perf_counter()
        assert 1e-7 < np.median(seconds) < 1e-3
