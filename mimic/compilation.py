"""Compilation in background threads, XLA's options, and the compilation cache.

Compilers release the GIL, so that Python does other work meanwhile.
"""

import contextlib
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax

from mimic.config import check_writable

WAITED = "/mimic/prepared/wait"  # an event of `jax.monitoring`

_GPU_COMPILER_OPTIONS = {
    # XLA's autotuning would try a dozen forms of each matrix product, which takes longer than it saves in a training.
    "xla_gpu_enable_triton_gemm": False,
    # Independent kernels run concurrently: on an H200 PPO is 30 % faster (6 % with MJX). Results are the same to the
    # bit if XLA chooses the same matrix products.
    "xla_gpu_command_buffer_scheduling_mode": "CONCURRENT",
}

# Collectives in CUDA graphs, so that all-reduces are overlapped with computation; the others are XLA's default.
_COLLECTIVES_IN_GRAPHS = {
    "xla_gpu_enable_command_buffer": "FUSION,CUBLAS,CUBLASLT,CUSTOM_CALL,CUDNN,DYNAMIC_SLICE_FUSION,COLLECTIVES"
}

T = TypeVar("T")


class Background(Generic[T]):
    """A value that is computed once: in a thread after `start`, otherwise at the first call.

    Args:
      make: computes the value; its exceptions are raised by the calls.
    """

    def __init__(self, make: Callable[[], T]):
        self._make = make
        self._future: Future[T] | None = None

    def start(self) -> None:
        """Starts the computation in a thread, unless it has started."""
        if self._future is None:
            executor = ThreadPoolExecutor(1, thread_name_prefix="prepared")
            self._future = executor.submit(self._make)
            executor.shutdown(wait=False)

    def __call__(self) -> T:
        """Returns the value, after waiting for it."""
        if self._future is None:
            value, self._future = self._make(), Future()
            self._future.set_result(value)
        if not self._future.done():
            began = time.perf_counter()
            self._future.result()
            jax.monitoring.record_event_duration_secs(WAITED, time.perf_counter() - began)
        return self._future.result()


def in_background(make: Callable[[], T]) -> Background[T]:
    """A `Background` that has started."""
    background = Background(make)
    background.start()
    return background


def compiling(function: Callable[..., T], *shapes: Any) -> Background[Callable[..., T]]:
    """`jax.jit` of a function for arguments of these shapes: traced now, compiled in the background.

    Args:
      function: a function of arrays.
      *shapes: arrays or `jax.ShapeDtypeStruct`s.
    """
    return in_background(jax.jit(function, compiler_options=compiler_options()).lower(*shapes).compile)


def compiler_options() -> dict[str, Any]:
    """XLA's options for the functions of a run on the default backend, without those that XLA_FLAGS sets."""
    if jax.default_backend() != "gpu":
        return {}
    options = {**_GPU_COMPILER_OPTIONS, **(_COLLECTIVES_IN_GRAPHS if a_process_for_each_gpu() else {})}
    set_by_user = {flag.partition("=")[0] for flag in os.environ.get("XLA_FLAGS", "").split()}
    return {name: value for name, value in options.items() if f"--{name}" not in set_by_user}


def a_process_for_each_gpu() -> bool:
    """Whether there are several GPUs and each has its own process."""
    return jax.default_backend() == "gpu" and jax.process_count() == jax.device_count() > 1


def on_host() -> contextlib.AbstractContextManager[Any]:
    """Context in which JAX computes on the CPU, if it may: the first computation on a GPU takes seconds to start."""
    with contextlib.suppress(RuntimeError):  # JAX_PLATFORMS excludes the CPU
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    return contextlib.nullcontext()


def use_compilation_cache(folder: str) -> None:
    """Lets JAX cache compiled functions in a folder, so that the same run starts faster the next time.

    Small functions are cached too: on a GPU each takes a tenth of a second to compile, and there are dozens.

    Args:
      folder: created if it does not exist; empty for no cache. One that cannot be written is not used.
    """
    if folder:
        try:
            check_writable("compilation_cache", Path(folder).expanduser())
        except ValueError as error:  # a run does without
            print(f"warning: {error}; all functions are compiled anew", file=sys.stderr)
            return
        jax.config.update("jax_compilation_cache_dir", str(Path(folder).expanduser()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def compilation_cache() -> Path | None:
    """The folder where JAX caches compiled functions, if any."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    return Path(folder) if folder else None
