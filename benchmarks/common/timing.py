"""Times a program as all benchmarks do: compilation apart, results waited for, median and quartiles of repeats."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

_REPEATS = 9
_PATIENCE_S = 10.0  # a call that takes longer is timed once
_LEAST_S = 0.02  # a repeat makes as many calls as take this long: the clock's start and stop are nothing to that


@dataclasses.dataclass(frozen=True)
class Timing:
    """Of one call of a program.

    Attributes:
      compile: seconds to trace and compile; 0 of what is not compiled.
      median, low, high: seconds of a call: median and quartiles of the repeats.
      bytes: of device memory that the program takes with its arguments and results; 0 where unknown.
    """

    compile: float
    median: float
    low: float
    high: float
    bytes: int = 0

    def summary(self) -> dict[str, float]:
        """For a file of results; the spread is the distance of the quartiles, as a share of the median."""
        spread = (self.high - self.low) / self.median
        return {"compile_s": round(self.compile, 3), "median_ms": 1e3 * self.median, "spread": round(spread, 4)}


def time_program(function: Callable[..., Any], *arguments: Any) -> Timing:
    """Compiles a function of arrays, and times calls of it."""
    program, compile_s = compiled(function, *arguments)
    memory: Any = program.memory_analysis()
    kinds = ("argument_size_in_bytes", "output_size_in_bytes", "temp_size_in_bytes")
    size = sum(getattr(memory, kind) for kind in kinds) if memory else 0
    timing = time_call(lambda: program(*arguments))
    return dataclasses.replace(timing, compile=compile_s, bytes=size)


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """A function of arrays, compiled for these; and the seconds that took."""
    began = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, time.perf_counter() - began


def time_call(call: Callable[[], Any], wait: Callable[[Any], Any] = jax.block_until_ready) -> Timing:
    """Times calls of a function, until what it returns is there.

    Args:
      call: of no arguments; called once before, for what is done the first time only.
      wait: for its result.
    """

    def seconds(calls: int) -> float:
        began = time.perf_counter()
        for _ in range(calls):
            result = call()
        wait(result)
        return (time.perf_counter() - began) / calls

    seconds(1)
    first = seconds(1)
    calls = max(1, round(_LEAST_S / first))
    taken = [first] if first > _PATIENCE_S else [seconds(calls) for _ in range(_REPEATS)]
    low, median, high = np.quantile(taken, [0.25, 0.5, 0.75])
    return Timing(0.0, float(median), float(low), float(high))
