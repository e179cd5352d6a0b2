"""Latency of one pose on one core: warm-started from the last pose of a motion, and from 13 initial guesses.

    python -m benchmarks.latency [--out FILE] [--poses 2000] [--runs 5] [--hand exact]

The process is bound to one core of Linux, and XLA computes in the caller's thread, as a control loop would have it.
`jit` is a caller inside `jax.jit`, `call` is `imitate_pose` itself, which also looks up what it compiled. Quantiles
are medians over runs. The last row is a loop of Python alone, which is as long each time: what its p99 is above its p50
is the machine's.
"""

import functools
import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect
from mimic.metric.config import MetricConfig

COLUMNS = "start way p50_us:.0f p99_us:.0f"
STARTS = {"free": ("warm", "13 initial guesses"), "exact": ("warm", "36 initial guesses")}


def bind_to_one_core() -> None:
    """Before JAX starts its threads."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def latencies(imitate: Callable[..., Any], motion: np.ndarray, *, warm: bool) -> np.ndarray:
    """Seconds of each pose of a motion, after the first tenth of them."""
    last, times = imitate(motion[0]).qpos, []
    for pose in motion:
        options = {"warm_start": last} if warm else {}
        began = time.perf_counter()
        last = jax.block_until_ready(imitate(pose, **options).qpos)
        times.append(time.perf_counter() - began)
    return np.array(times[len(times) // 10 :])


def loop_seconds(repeats: int) -> np.ndarray:
    """Seconds of a loop of Python that does the same each time."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        sum(range(7000))
        times.append(time.perf_counter() - began)
    return np.array(times)


def run_way(way: str, start: str, poses: int, runs: int, hand: str) -> Row:
    swing = np.sin(np.linspace(0, 20, poses)[:, None] + np.arange(7))
    options: dict[str, Any] = {"hand": hand}
    if hand == "exact":
        arm = mimic.panda(limits="hardware")
        pair, options["base"], swing = (arm, arm), [0.1, -0.1, 0.05, 0.3], arm.home + 0.3 * swing
    else:
        pair = mimic.panda(), mimic.panda(locked=(3, 6, 7))
    imitate = functools.partial(mimic.imitate_pose, *pair, **MetricConfig().build(*pair).arguments, **options)
    if way == "jit":
        imitate = jax.jit(imitate)
    motion = swing.astype(np.float32)
    times = np.array([latencies(imitate, motion, warm=start == "warm") for _ in range(runs)])
    return row(start, way, times)


def row(start: str, way: str, times: np.ndarray) -> Row:
    """The quantiles of times [runs, poses]."""
    p50, p99 = 1e6 * np.quantile(times, [0.5, 0.99], axis=1)
    return {"start": start, "way": way, "p50_us": float(np.median(p50)), "p99_us": float(np.median(p99))}


def measure(poses: int, runs: int, hand: str) -> Iterator[Row]:
    for start in STARTS[hand]:
        for way in ("jit", "call"):
            yield run_way(way, start, poses, runs, hand)
    yield row("", "loop of Python", np.array([loop_seconds(poses) for _ in range(runs)]))


def main() -> None:
    options = make_parser("latency", __doc__, poses=2000, runs=5, hand="free").parse_args()
    bind_to_one_core()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    collect(options, measure(options.poses, options.runs, options.hand), "results", COLUMNS)


if __name__ == "__main__":
    main()
