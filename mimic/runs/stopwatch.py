"""Wall time of a run, by stage."""

import contextlib
import threading
import time
from collections.abc import Iterator
from typing import Any

import jax

from mimic.base.compilation import WAITED


class Stopwatch:
    """Measures wall time by stage; tracing and compilation by JAX are a stage of their own. Stages may be nested.

    Compilation in other threads counts only while this thread waits for it.
    """

    _COMPILE_EVENTS = ("/jax/core/compile/", WAITED)

    def __init__(self, started: float):
        """Starts to measure.

        Args:
          started: `time.perf_counter()` at the start of the process.
        """
        self.started = started
        self._compiling = 0.0
        self._thread = threading.get_ident()
        self.seconds: dict[str, float] = {"import": time.perf_counter() - started, "compile": 0.0}
        jax.monitoring.register_event_duration_secs_listener(self._count)

    def _count(self, event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith(self._COMPILE_EVENTS) and threading.get_ident() == self._thread:
            self._compiling += duration_secs

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Context that measures a stage, without compilation and without nested stages."""
        began, counted = time.perf_counter(), sum(self.seconds.values())
        compiling = self._compiling
        try:
            yield
        finally:
            within = sum(self.seconds.values()) - counted  # nested stages with their compilation
            elapsed = time.perf_counter() - began - within
            compiled = min(self._compiling - compiling, elapsed)
            self._compiling = compiling
            self.seconds["compile"] += compiled
            self.seconds[name] = self.seconds.get(name, 0.0) + elapsed - compiled

    def report(self) -> dict[str, float]:
        """Seconds by stage, and the total since the start of the process."""
        order = ("import", "build", "compile", "train", "evaluate")
        seconds = {name: round(self.seconds.get(name, 0.0), 3) for name in order}
        return {**seconds, "total": round(time.perf_counter() - self.started, 3)}
