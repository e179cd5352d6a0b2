"""Compilation in background threads, once for equal arguments, XLA's options, and the compilation cache.

Compilers release the GIL, so that Python does other work meanwhile.
"""

import contextlib
import dataclasses
import functools
import os
import sys
import time
import warnings
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax
import numpy as np
from jax.core import Tracer

from mimic.base.config import check_writable

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

# A fifth less to compile on a CPU than XLA's default, 3; what is computed here is as fast, to 2 %.
_QUICK_CPU_OPTIONS = {"xla_backend_optimization_level": 1}
UNOPTIMIZED = {"xla_backend_optimization_level": 0}  # half to compile again, for what takes little time to run
_KEPT_RESULTS = 32  # of each function that is cached by value; a compiled function takes some MB

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

    @property
    def done(self) -> bool:
        """Whether the computation has ended, or failed."""
        return self._future is not None and self._future.done()

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


def by_value(function: Callable[..., T], uncached: Callable[..., T] | None = None) -> Callable[..., T]:
    """The function with a cache of its last 32 results, by the values of its arguments.

    Numbers, arrays, dataclasses (arms, metrics), and tuples, lists and dicts of them are equal by value. Functions are
    equal by identity, `functools.partial` by its parts; so a function must be pure.

    Args:
      function: of positional arguments.
      uncached: called instead for arguments that contain tracers or values without hash; `function` by default.
    """

    @functools.lru_cache(maxsize=_KEPT_RESULTS)
    def kept(arguments: _ByValue) -> T:
        return function(*arguments.value)

    @functools.wraps(function)
    def lookup(*arguments: Any) -> T:
        try:
            key = value_key(arguments)
        except TypeError:
            return (uncached or function)(*arguments)
        return kept(_ByValue(arguments, key))

    return lookup


def compiled_once(
    make: Callable[..., Callable[..., T]], options: Mapping[str, Any] = _QUICK_CPU_OPTIONS
) -> Callable[..., Callable[..., T]]:
    """A maker of functions that returns the same compiled function for equal arguments: see `by_value`.

    Args:
      make: from arguments that are constant in the compiled function to a function of arrays, at least one of them made
        by `jax.numpy`, so that it is a tracer while JAX traces.
      options: of XLA on a CPU.
    """

    def compiled(*arguments: Any) -> Callable[..., T]:
        return _compiled(make(*arguments), options)

    return functools.wraps(make)(by_value(compiled, lambda *arguments: jax.jit(make(*arguments))))


def _compiled(function: Callable[..., T], options: Mapping[str, Any]) -> Callable[..., T]:
    """The function, compiled quickly for concrete arrays; inside a trace it becomes part of that."""
    traced = jax.jit(function)
    quick = jax.jit(function, compiler_options=_quick_options(options))  # JAX takes options only outside of a trace

    def call(*arrays: Any) -> T:
        return traced(*arrays) if has_tracer(arrays) else quick(*arrays)

    return call


def compiled_quickly(
    function: Callable[..., T], *shapes: Any, options: Mapping[str, Any] = _QUICK_CPU_OPTIONS
) -> Callable[..., T]:
    """The function, compiled for arguments of these shapes, also while JAX traces another one."""
    return jax.jit(function, compiler_options=_quick_options(options)).lower(*shapes).compile()


def has_tracer(tree: Any) -> bool:
    """Whether a value is only known while JAX traces."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


@dataclasses.dataclass(frozen=True)
class _ByValue:
    """Arguments, equal where their keys are."""

    value: tuple[Any, ...] = dataclasses.field(compare=False)
    key: Hashable


def value_key(tree: Any) -> Hashable:
    """A key of a pytree, dataclass or function that is equal for equal values; see `by_value`.

    Raises:
      TypeError: it contains a tracer or a value without hash.
    """
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple(map(_leaf_key, leaves))


def _leaf_key(leaf: Any) -> Hashable:
    kind = type(leaf)  # the frequent types first: each call of `imitate_pose` makes the keys of two arms
    if kind in (float, int, bool, str):
        return kind, leaf
    if kind is np.ndarray:
        return False, leaf.dtype.str, leaf.shape, leaf.tobytes()
    if isinstance(leaf, Tracer):
        raise TypeError("expected a concrete value, got a tracer")
    if isinstance(leaf, jax.Array) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return str(leaf.dtype), _leaf_key(jax.random.key_data(leaf))
    if isinstance(leaf, np.ndarray | np.generic | jax.Array):
        array = np.asarray(leaf)
        return isinstance(leaf, jax.Array), array.dtype.str, array.shape, array.tobytes()
    if isinstance(leaf, functools.partial):
        return functools.partial, value_key((leaf.func, leaf.args, leaf.keywords))
    if dataclasses.is_dataclass(leaf) and not isinstance(leaf, type):
        return type(leaf), value_key([getattr(leaf, field.name) for field in dataclasses.fields(leaf)])
    hash(leaf)
    return type(leaf), leaf


def _quick_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """XLA's options for a function that compiles quickly on a CPU, without those that XLA_FLAGS sets."""
    device = jax.config.values["jax_default_device"] or jax.default_backend()
    if getattr(device, "platform", device) != "cpu":
        return {}
    return _without_those_of_user(dict(options))


def compiler_options() -> dict[str, Any]:
    """XLA's options for the functions of a run on the default backend, without those that XLA_FLAGS sets."""
    if jax.default_backend() != "gpu":
        return {}
    return _without_those_of_user(
        {**_GPU_COMPILER_OPTIONS, **(_COLLECTIVES_IN_GRAPHS if a_process_for_each_gpu() else {})}
    )


def _without_those_of_user(options: dict[str, Any]) -> dict[str, Any]:
    """XLA's options without those that XLA_FLAGS sets."""
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
        # On a full disk: an entry that is not written, or truncated, is compiled anew.
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")


def compilation_cache() -> Path | None:
    """The folder where JAX caches compiled functions, if any."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    return Path(folder) if folder else None
