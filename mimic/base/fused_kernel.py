"""Scalar-component functions over a batch: one Pallas kernel on NVIDIA GPUs, batched XLA code elsewhere."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array

from mimic.base.spatial import Scalar, stack

ScalarFunction = Callable[..., Sequence[Sequence[Scalar]]]


@dataclasses.dataclass(frozen=True)
class LaunchConfig:
    """Launch configuration of a Pallas kernel. The defaults are the fastest measured on an H200.

    Samples are the first axis: a thread reads adjacent numbers, and a warp reads whole cache lines. Transposing the few
    columns would only move them through memory once more.

    Attributes:
      block: samples in a block; a power of 2.
      warps: groups of 32 threads in a block.
    """

    block: int = 128
    warps: int = 4


DEFAULT = LaunchConfig()


def fused(
    function: ScalarFunction,
    widths: Sequence[int],
    *,
    plain: Callable[..., tuple[Array, ...]] | None = None,
    launch: LaunchConfig = DEFAULT,
) -> Callable[..., tuple[Array, ...]]:
    """A function of vectors whose `jax.vmap` is one kernel on NVIDIA GPUs.

    A sample stays in the registers of one thread from start to end. XLA would split a long function into many kernels
    and write their results to memory.

    Args:
      function: takes a sequence of scalars for each vector and returns sequences of scalars. It must be elementwise,
        like the functions of `mimic.base.spatial`: in the kernel a scalar is a block of samples.
      widths: length of each returned sequence.
      plain: the same function on vectors, for other devices; `function` itself where None.
      launch: launch configuration of the kernel.

    Returns:
      The function of vectors, which have one floating dtype. Its derivatives are those of `function`, compiled by XLA.
    """

    def by_vectors(*vectors: Array) -> tuple[Array, ...]:
        outputs = function(*([vector[k] for k in range(vector.shape[0])] for vector in vectors))
        return tuple(stack([scalars], vectors[0].dtype)[0] for scalars in outputs)

    def sequential(*vectors: Array) -> tuple[Array, ...]:
        outputs: list[Array] = []
        for index in range(len(widths)):
            vectors, outputs = jax.lax.optimization_barrier((vectors, outputs))
            outputs.append(of_sample(*vectors)[index])
        return tuple(outputs)

    of_sample = jax.jit(plain or by_vectors)  # traced once for all outputs and all callers
    # For several outputs together XLA's CPU compiler recomputes common subexpressions many times: the distance and its
    # gradient with respect to the learner's angles took seven times as long (measured).
    return batched_by(gpu_kernel(function, widths, launch), of_sample, of_sample if plain else sequential)


def batched_by(
    kernel: Callable[..., tuple[Array, ...]],
    of_sample: Callable[..., tuple[Array, ...]],
    elsewhere: Callable[..., tuple[Array, ...]] | None = None,
) -> Callable[..., tuple[Array, ...]]:
    """A function of vectors whose `jax.vmap` is a kernel on NVIDIA GPUs.

    Args:
      kernel: takes and returns arrays [samples, width].
      of_sample: the same for one sample; defines the derivatives.
      elsewhere: the same for one sample, batched on other devices; `of_sample` where None.
    """
    batched_elsewhere = jax.vmap(elsewhere or of_sample)
    function = jax.custom_jvp(jax.custom_batching.custom_vmap(of_sample))
    function.defjvp(lambda primals, tangents: jax.jvp(of_sample, primals, tangents))

    @function.fun.def_vmap
    def batch(size: int, batched: Any, *vectors: Array) -> Any:
        rows = [
            vector if is_batched else jnp.broadcast_to(vector, (size, *vector.shape))
            for vector, is_batched in zip(vectors, batched, strict=True)
        ]
        outputs = jax.lax.platform_dependent(*rows, cuda=kernel, default=batched_elsewhere)
        return outputs, (True,) * len(outputs)

    return function


def with_batch_last(step: Callable[..., tuple[Array, ...]]) -> Callable[..., tuple[Array, ...]]:
    """A function of vectors whose batch is the last axis of the arrays of `step`, so that its loops are vectorized."""
    function = jax.custom_batching.custom_vmap(step)

    @function.def_vmap
    def batch(size: int, batched: Any, *vectors: Array) -> Any:
        columns = [
            jnp.moveaxis(vector, 0, -1) if is_batched else jnp.broadcast_to(vector[:, None], (*vector.shape, size))
            for vector, is_batched in zip(vectors, batched, strict=True)
        ]
        outputs = tuple(jnp.moveaxis(x, -1, 0) for x in step(*columns))
        return outputs, (True,) * len(outputs)

    return function


def gpu_kernel(
    function: ScalarFunction, widths: Sequence[int], launch: LaunchConfig = DEFAULT
) -> Callable[..., tuple[Array, ...]]:
    """A function over arrays [samples, width], as one Pallas kernel.

    Args:
      function: see `fused`.
      widths: see `fused`.
      launch: launch configuration of the kernel.
    """

    def body(inputs: Sequence[Columns], outputs: Sequence[Columns]) -> None:
        # Column indices are arrays, because interpret mode rejects plain numbers.
        scalars_of_inputs = [[columns.read(jnp.asarray(k)) for k in range(columns.width)] for columns in inputs]
        for columns, scalars in zip(outputs, function(*scalars_of_inputs), strict=True):
            for k, value in enumerate(scalars):
                columns.write(jnp.asarray(k), value)

    return by_columns(body, widths, launch=launch)


@dataclasses.dataclass(frozen=True)
class Columns:
    """A block of the rows of an array [samples, width], which a kernel reads and writes by columns.

    Attributes:
      ref: reference to the block.
      mask: valid samples; the last block may be partial.
    """

    ref: Any
    mask: Array

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.ref.shape[1]

    def _at(self, column: Array) -> Any:
        return self.ref.at[:, column.astype(int)]  # the type of a slice's start, which interpret mode requires

    def read(self, column: Array) -> Array:
        """Reads a column, [block]."""
        return triton.load(self._at(column), mask=self.mask, other=0.0)

    def write(self, column: Array, values: Scalar) -> None:
        """Writes a column."""
        values = jnp.broadcast_to(jnp.asarray(values, self.ref.dtype), self.mask.shape)
        triton.store(self._at(column), values, mask=self.mask)


# Above 40 lines because of its docstring.
def by_columns(
    body: Callable[..., None], widths: Sequence[int], *, launch: LaunchConfig = DEFAULT
) -> Callable[..., tuple[Array, ...]]:
    """A function of arrays [samples, width] as one Pallas kernel: a thread computes a sample.

    Args:
      body: takes `Columns` of the inputs and `Columns` of the outputs.
      widths: of the output arrays.
      launch: launch configuration of the kernel.
    """
    block = launch.block

    def window(width: int) -> pl.BlockSpec:
        return pl.BlockSpec((block, width), lambda i: (i, 0))

    def batched(*rows: Array) -> tuple[Array, ...]:
        count, dtype = rows[0].shape[0], rows[0].dtype

        def kernel(*refs: Any) -> None:
            mask = pl.program_id(0) * block + jnp.arange(block) < count
            groups = refs[: len(rows)], refs[len(rows) :]
            body(*([Columns(ref, mask) for ref in group] for group in groups))

        outputs = pl.pallas_call(
            kernel,
            out_shape=[jax.ShapeDtypeStruct((count, width), dtype) for width in widths],
            grid=(pl.cdiv(count, block),),
            in_specs=[window(x.shape[1]) for x in rows],
            out_specs=[window(width) for width in widths],
            compiler_params=triton.CompilerParams(num_warps=launch.warps, num_stages=1),
        )(*rows)
        return tuple(outputs)

    return batched
