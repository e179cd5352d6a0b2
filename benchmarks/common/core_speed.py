"""The speed of a core over time: on a virtual machine the host may give half of a physical core to somebody else."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np

# Notes a time and the duration of a loop [s], the shortest one in each 4 ms, and prints all when it is terminated.
_LOOP = """
import math, os, signal, sys, time
os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))  # itself, at once: it inherits a real-time priority
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
ended, samples, clock = [], [], time.perf_counter
best, begun = math.inf, clock()
print("ready", flush=True)
while not (ended and samples) and os.getppid() == int(sys.argv[1]):
    start = clock()
    sum(range(500))
    end = clock()
    best = min(best, end - start)
    if end > begun + 0.004:
        samples.append((end, best))
        best, begun = math.inf, end
for sample in samples:
    print(*sample)
"""
_FULL_SPEED = 1.25  # maximum duration, relative to the shortest; half of a physical core takes 1.5 to 2 times as long
Samples = list[tuple[float, float]]


@contextlib.contextmanager
def measured_speed(core: int | None) -> Iterator[Samples]:
    """Context in which a process of the lowest priority times a loop on a core, which does not halt; none for None.

    Linux only. It takes the place of that of `mimic.deploy.cores.awake_core`: with two such processes on a core, other
    processes may wait for 4 ms when they wake up.

    Yields:
      Times of `time.perf_counter` and durations of the loop [s]; empty until the context ends.
    """
    samples: Samples = []
    if core is None:
        yield samples
        return
    command = [sys.executable, "-I", "-S", "-c", _LOOP, str(os.getpid())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            os.sched_setaffinity(process.pid, {core})
            yield samples
            process.terminate()
            lines = process.communicate()[0].splitlines()
        finally:
            process.kill()
    samples += [(float(at), float(seconds)) for at, seconds in (line.split() for line in lines)]


def loop_durations(samples: Samples, times: np.ndarray) -> np.ndarray:
    """Durations of the loop at some times [s]: the longer ones of the samples before and after each."""
    at, seconds = np.array(samples).T
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    return np.maximum(seconds[after - 1], seconds[after])


def shortest_loop(samples: Samples) -> float:
    """The duration of the loop at full speed [s], if the core ever had it; without the 1 % of outliers."""
    return float(np.percentile([seconds for _, seconds in samples], 1))


def is_full_speed(durations: np.ndarray, shortest: float) -> np.ndarray:
    """Which of these durations of the loop are those of a core at full speed, where it takes `shortest`."""
    return durations < _FULL_SPEED * shortest
