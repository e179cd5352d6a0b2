"""Timing of all benchmarks: compilation apart, results waited for, median and quartiles of repeats."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

_LONGEST_S = 10.0  # a call that takes longer is timed once
_SHORTEST_S = 0.02  # minimum duration of a repeat, by several calls, so that the clock's overhead is negligible


@dataclasses.dataclass(frozen=True)
class Timing:
    """Time of a call [s]: median and quartiles of the repeats."""

    result: Any  # of the last call
    first: float  # the first call
    median: float
    low: float
    high: float
    compile: float = 0.0  # tracing and compiling; 0 for what is not compiled by JAX
    bytes: int = 0  # device memory of the compiled function with its arguments and results; 0 where unknown

    def summary(self) -> dict[str, float]:
        """Entries of a results file; the spread is the interquartile range relative to the median."""
        spread = round((self.high - self.low) / self.median, 4)
        return {"compile_s": round(self.compile, 3), "median_ms": 1e3 * self.median, "spread": spread}


def time_program(function: Callable[..., Any], *arguments: Any) -> Timing:
    began = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    compile_s = time.perf_counter() - began
    memory: Any = program.memory_analysis()
    size = sum(getattr(memory, f"{kind}_size_in_bytes", 0) for kind in ("argument", "output", "temp"))
    return dataclasses.replace(time_call(lambda: program(*arguments)), compile=compile_s, bytes=size)


def time_call(call: Callable[[], Any], repeats: int = 9) -> Timing:
    """Times calls of a function of no arguments, each until its result is there."""
    result: Any = None

    def seconds(calls: int) -> float:
        nonlocal result
        began = time.perf_counter()
        for _ in range(calls):
            result = call()
        jax.block_until_ready(result)
        return (time.perf_counter() - began) / calls

    first, second = seconds(1), seconds(1)
    calls = max(1, round(_SHORTEST_S / second))
    times = [second] if second > _LONGEST_S else [seconds(calls) for _ in range(repeats)]
    low, median, high = np.quantile(times, [0.25, 0.5, 0.75]).tolist()
    return Timing(result, first, median, low, high)


def summary_of_rates(rates: Sequence[float]) -> dict[str, float]:
    """Median of steps per second, and spread: the interquartile range relative to it."""
    low, median, high = np.quantile(rates, [0.25, 0.5, 0.75]).tolist()
    return {"steps_per_s": median, "spread": round((high - low) / median, 4)}
