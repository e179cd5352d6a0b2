"""The speed of cores over time: on a virtual machine the host may give half of a physical core to somebody else."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator

import numpy as np

# Notes a time and the duration of a loop [s], the shortest one in each 4 ms, and prints all when it is terminated.
_LOOP = """
import signal, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
ended, samples, clock = [], [], time.perf_counter
best, begun = 1.0, clock()
print("ready", flush=True)
while not ended:
    start = clock()
    sum(range(500))
    end = clock()
    best = min(best, end - start)
    if end > begun + 0.004:
        samples.append((end, best))
        best, begun = 1.0, end
for sample in samples:
    print(*sample)
"""
_FULL_SPEED = 1.25  # maximum duration, relative to the shortest; half of a physical core takes 1.5 to 2 times as long


@contextlib.contextmanager
def measured_speeds(cores: Iterable[int]) -> Iterator[dict[int, list[tuple[float, float]]]]:
    """Context in which a process of the lowest priority times a loop on each of some cores, which do not halt.

    Linux only. It takes the place of that of `mimic.deploy.cores.awake_core`: with two such processes on a core, other
    processes may wait for 4 ms when they wake up.

    Yields:
      For each core, times of `time.perf_counter` and durations of the loop [s]; empty until the context ends.
    """
    samples: dict[int, list[tuple[float, float]]] = {core: [] for core in cores}
    allowed = os.sched_getaffinity(0)
    with contextlib.ExitStack() as stack:
        processes = {core: stack.enter_context(_loop_process(core)) for core in samples}
        yield samples
        for core, process in processes.items():
            os.sched_setaffinity(process.pid, allowed)  # on a busy core it would take long to end
            os.sched_setscheduler(process.pid, os.SCHED_OTHER, os.sched_param(0))
            process.terminate()
            lines = process.communicate()[0].splitlines()
            samples[core] += [(float(at), float(seconds)) for at, seconds in (line.split() for line in lines)]


@contextlib.contextmanager
def _loop_process(core: int) -> Iterator["subprocess.Popen[str]"]:
    """Context with the process on a core."""
    with subprocess.Popen([sys.executable, "-I", "-S", "-c", _LOOP], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            os.sched_setaffinity(process.pid, {core})
            os.sched_setscheduler(process.pid, os.SCHED_IDLE, os.sched_param(0))
            yield process
        finally:
            process.kill()


def loop_durations(samples: list[tuple[float, float]], times: np.ndarray) -> np.ndarray:
    """Durations of the loop at some times [s]: the longer ones of the samples before and after each."""
    at, seconds = np.array(samples).T
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    return np.maximum(seconds[after - 1], seconds[after])


def is_full_speed(durations: np.ndarray) -> np.ndarray:
    """Which of these durations of the loop are those of cores at full speed, some of which must be."""
    return durations < _FULL_SPEED * np.percentile(durations, 1)
