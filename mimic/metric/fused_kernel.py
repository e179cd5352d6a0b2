"""Scalar-component code over a batch: one GPU kernel on NVIDIA, a plain batched program elsewhere."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array

from mimic.metric.spatial import Scalar, stack

Program = Callable[..., Sequence[Sequence[Scalar]]]


@dataclasses.dataclass(frozen=True)
class LaunchConfig:
    """How a GPU kernel shares out its work: where nothing is said, what was the fastest on an H200 by measurement.

    Where samples are the first axis, a thread reads numbers that lie side by side, so that a group of threads reads
    whole lines of the cache. That is best for few columns, which are all read at once: to transpose them first would
    only move them through memory once more. Many columns, one after the other, would throw each other out of the cache.

    Attributes:
      block: samples in a block; a power of 2.
      warps: groups of 32 threads in a block.
      sample_axis: of the arrays within the kernel; those outside, [samples, width], are transposed where it is 1.
    """

    block: int = 128
    warps: int = 4
    sample_axis: int = 0


DEFAULT = LaunchConfig()


def fused(
    program: Program,
    widths: Sequence[int],
    *,
    plain: Callable[..., tuple[Array, ...]] | None = None,
    layout: LaunchConfig = DEFAULT,
) -> Callable[..., tuple[Array, ...]]:
    """A function of vectors whose `jax.vmap` is one kernel on NVIDIA GPUs.

    A sample stays in the registers of one thread from start to end. XLA would split a long program into many kernels,
    and each of their results would go through memory.

    Args:
      program: of one sequence of scalars for each vector; gives sequences of scalars. It must be elementwise, as what
        `mimic.metric.spatial` does: in the kernel a scalar is a block of samples.
      widths: length of each sequence that the program gives.
      plain: the same on vectors, for where there is no such GPU; the program itself where None.
      layout: of the kernel.

    Returns:
      The function, of vectors of one floating dtype. Its derivatives are those of the program, as XLA compiles it.
    """

    def by_program(*vectors: Array) -> tuple[Array, ...]:
        outputs = program(*([vector[k] for k in range(vector.shape[0])] for vector in vectors))
        return tuple(stack([scalars], vectors[0].dtype)[0] for scalars in outputs)

    def one_after_the_other(*vectors: Array) -> tuple[Array, ...]:
        done: list[Array] = []
        for index in range(len(widths)):
            vectors, done = jax.lax.optimization_barrier((vectors, done))
            done.append(one(*vectors)[index])
        return tuple(done)

    one = jax.jit(plain or by_program)  # traced once for all outputs, and for all programs that ask for it
    # Asked for several outputs at once, XLA's CPU compiler computes what they share many times over: the distance and
    # its gradient by the learner's angles took seven times as long (by measurement).
    return batched_by(gpu_kernel(program, widths, layout), one, one if plain else one_after_the_other)


def batched_by(
    kernel: Callable[..., tuple[Array, ...]],
    one: Callable[..., tuple[Array, ...]],
    elsewhere: Callable[..., tuple[Array, ...]] | None = None,
) -> Callable[..., tuple[Array, ...]]:
    """A function of vectors whose `jax.vmap` is a kernel on NVIDIA GPUs.

    Args:
      kernel: of arrays [samples, width]; gives such arrays.
      one: the same of one sample; the function's derivatives are those of it.
      elsewhere: the same, to be batched where there is no such GPU; `one` where None.
    """
    many_elsewhere = jax.vmap(elsewhere or one)
    function = jax.custom_jvp(jax.custom_batching.custom_vmap(one))
    function.defjvp(lambda primals, tangents: jax.jvp(one, primals, tangents))

    @function.fun.def_vmap
    def many(size: int, batched: Any, *vectors: Array) -> Any:
        rows = [
            vector if is_batched else jnp.broadcast_to(vector, (size, *vector.shape))
            for vector, is_batched in zip(vectors, batched, strict=True)
        ]
        made = jax.lax.platform_dependent(*rows, cuda=kernel, default=many_elsewhere)
        return made, (True,) * len(made)

    return function


def gpu_kernel(
    program: Program, widths: Sequence[int], layout: LaunchConfig = DEFAULT
) -> Callable[..., tuple[Array, ...]]:
    """The program over arrays [samples, width], as one Pallas kernel.

    Args:
      program: see `fused`.
      widths: see `fused`.
      layout: of the kernel.
    """

    def body(given: Sequence[Columns], made: Sequence[Columns]) -> None:
        # Columns are named by arrays, because interpret mode refuses plain numbers.
        inputs = [[columns.read(jnp.asarray(k)) for k in range(columns.width)] for columns in given]
        for columns, scalars in zip(made, program(*inputs), strict=True):
            for k, value in enumerate(scalars):
                columns.write(jnp.asarray(k), value)

    return by_columns(body, widths, layout=layout)


@dataclasses.dataclass(frozen=True)
class Columns:
    """What a kernel sees of an array [samples, width]: a block of its rows, column by column.

    Attributes:
      ref: of the block.
      inside: which of its samples there are: the last block may stick out.
      sample_axis: of the array.
    """

    ref: Any
    inside: Array
    sample_axis: int

    @property
    def width(self) -> int:
        """How many columns."""
        return self.ref.shape[1 - self.sample_axis]

    def _at(self, column: Array) -> Any:
        # Of one kind with the start of a slice, which interpret mode asks for.
        column = jnp.maximum(column, 0).astype(int)
        return self.ref.at[column, :] if self.sample_axis else self.ref.at[:, column]

    def read(self, column: Array) -> Array:
        """A column, [block]; 0 where its number is negative."""
        there = self.inside & (column >= 0)
        return triton.load(self._at(column), mask=there, other=0.0)

    def write(self, column: Array, values: Scalar) -> None:
        """A column; none where its number is negative."""
        there = self.inside & (column >= 0)
        values = jnp.broadcast_to(jnp.asarray(values, self.ref.dtype), self.inside.shape)
        triton.store(self._at(column), values, mask=there)


def by_columns(
    body: Callable[..., None], widths: Sequence[int], *tables: np.ndarray, layout: LaunchConfig = DEFAULT
) -> Callable[..., tuple[Array, ...]]:
    """A function of arrays [samples, width] as one Pallas kernel: a thread computes a sample.

    Args:
      body: of `Columns` of what is given and of what is made, and of references to the tables.
      widths: of the arrays that are made.
      *tables: what all samples share.
      layout: of the kernel.
    """
    block, sample_axis = layout.block, layout.sample_axis

    def window(width: int) -> pl.BlockSpec:
        if sample_axis:
            return pl.BlockSpec((width, block), lambda i: (0, i))
        return pl.BlockSpec((block, width), lambda i: (i, 0))

    def batched(*rows: Array) -> tuple[Array, ...]:
        count, dtype = rows[0].shape[0], rows[0].dtype

        def kernel(*refs: Any) -> None:
            inside = pl.program_id(0) * block + jnp.arange(block) < count
            given, shared = refs[: len(rows)], refs[len(rows) : len(rows) + len(tables)]
            made = refs[len(rows) + len(tables) :]
            body(*([Columns(ref, inside, sample_axis) for ref in own] for own in (given, made)), *shared)

        numbers = [jnp.asarray(x, dtype if np.issubdtype(x.dtype, np.floating) else x.dtype) for x in tables]
        whole = [pl.BlockSpec(x.shape, lambda i, rank=x.ndim: (0,) * rank) for x in tables]
        shapes = [(width, count) if sample_axis else (count, width) for width in widths]
        made = pl.pallas_call(
            kernel,
            out_shape=[jax.ShapeDtypeStruct(shape, dtype) for shape in shapes],
            grid=(pl.cdiv(count, block),),
            in_specs=[*(window(x.shape[1]) for x in rows), *whole],
            out_specs=[window(width) for width in widths],
            compiler_params=triton.CompilerParams(num_warps=layout.warps, num_stages=1),
        )(*(x.T if sample_axis else x for x in rows), *numbers)
        return tuple(x.T if sample_axis else x for x in made)

    return batched
