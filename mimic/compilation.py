"""Work that goes on in the background: compilers leave Python free to do something else."""

import contextlib
import os
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax

WAITED = "/mimic/prepared/wait"  # an event of `jax.monitoring`

_GPU_COMPILER_OPTIONS = {
    # XLA would try each matrix product in a dozen forms, which takes longer than it saves in a training.
    "xla_gpu_enable_triton_gemm": False,
    # Kernels that do not depend on each other run at the same time: on an H200 PPO is 30 % faster (6 % with MJX), and
    # learns the same to the bit where XLA picks the same matrix products.
    "xla_gpu_command_buffer_scheduling_mode": "CONCURRENT",
}

# Messages between GPUs within CUDA graphs, so that they go on beside computation; the rest is there by default.
_MESSAGES = {
    "xla_gpu_enable_command_buffer": "FUSION,CUBLAS,CUBLASLT,CUSTOM_CALL,CUDNN,DYNAMIC_SLICE_FUSION,COLLECTIVES"
}

T = TypeVar("T")


class Background(Generic[T]):
    """What is made once: in a thread of its own from `start` on, else when it is first asked for.

    Args:
      make: returns it; what it raises is raised where it is asked for.
    """

    def __init__(self, make: Callable[[], T]):
        self._make = make
        self._future: Future[T] | None = None

    def start(self) -> None:
        """Begins, unless it has begun."""
        if self._future is None:
            executor = ThreadPoolExecutor(1, thread_name_prefix="prepared")
            self._future = executor.submit(self._make)
            executor.shutdown(wait=False)

    def __call__(self) -> T:
        """The result; waits for it."""
        if self._future is None:
            made, self._future = self._make(), Future()
            self._future.set_result(made)
        if not self._future.done():
            began = time.perf_counter()
            self._future.result()
            jax.monitoring.record_event_duration_secs(WAITED, time.perf_counter() - began)
        return self._future.result()


def compiling(function: Callable[..., T], *shapes: Any) -> Background[Callable[..., T]]:
    """`jax.jit` of a function for arguments of these shapes: traced now, compiled in the background.

    Args:
      function: of arrays.
      *shapes: arrays, or `jax.ShapeDtypeStruct`s in their place.
    """
    program = Background(jax.jit(function, compiler_options=compiler_options()).lower(*shapes).compile)
    program.start()
    return program


def compiler_options() -> dict[str, Any]:
    """For programs that are compiled for one run, on the present backend; without what the user set in XLA_FLAGS."""
    if jax.default_backend() != "gpu":
        return {}
    options = {**_GPU_COMPILER_OPTIONS, **(_MESSAGES if a_process_for_each_gpu() else {})}
    given = {flag.partition("=")[0] for flag in os.environ.get("XLA_FLAGS", "").split()}
    return {name: value for name, value in options.items() if f"--{name}" not in given}


def a_process_for_each_gpu() -> bool:
    """Whether there are several GPUs, none of which shares its process with another."""
    return jax.default_backend() == "gpu" and jax.process_count() == jax.device_count() > 1


def on_host() -> contextlib.AbstractContextManager[Any]:
    """Where the processor computes, if JAX may use it: the first work on a GPU waits for seconds."""
    with contextlib.suppress(RuntimeError):  # JAX_PLATFORMS names others alone
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    return contextlib.nullcontext()


def use_compilation_cache(folder: str) -> None:
    """Lets JAX keep compiled programs in a folder, so that the same run starts faster the next time.

    The small ones too: on a GPU each takes a tenth of a second, and there are dozens.
    """
    if folder:
        jax.config.update("jax_compilation_cache_dir", str(Path(folder).expanduser()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
