"""Scalar-component code over a batch: one GPU kernel on NVIDIA, a plain batched program elsewhere."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array

from mimic.spatial import Scalar, stack

BLOCK, WARPS = 128, 4  # samples, and groups of 32 threads, in a block of the GPU kernel (by measurement)

Program = Callable[..., Sequence[Sequence[Scalar]]]


def fused(
    program: Program,
    widths: Sequence[int],
    *,
    plain: Callable[..., tuple[Array, ...]] | None = None,
    block: int = BLOCK,
    warps: int = WARPS,
) -> Callable[..., tuple[Array, ...]]:
    """A function of vectors whose `jax.vmap` is one kernel on NVIDIA GPUs.

    A sample stays in the registers of one thread from start to end. XLA would split a long program into many kernels,
    and each of their results would go through memory.

    Args:
      program: of one sequence of scalars for each vector; gives sequences of scalars. It must be elementwise, as what
        `mimic.spatial` does: in the kernel a scalar is a block of samples.
      widths: length of each sequence that the program gives.
      plain: the same on vectors, for where there is no such GPU; the program itself where None.
      block: see `gpu_kernel`.
      warps: see `gpu_kernel`.

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
            done.append(by_program(*vectors)[index])
        return tuple(done)

    one = plain or by_program
    # Asked for several outputs at once, XLA's CPU compiler computes what they share many times over: the distance and
    # its gradient by the learner's angles took seven times as long (by measurement).
    many_elsewhere = jax.vmap(plain or one_after_the_other)
    function = jax.custom_jvp(jax.custom_batching.custom_vmap(one))
    function.defjvp(lambda primals, tangents: jax.jvp(one, primals, tangents))
    kernel = gpu_kernel(program, widths, block, warps)

    @function.fun.def_vmap
    def many(size: int, batched: Any, *vectors: Array) -> Any:
        rows = [
            vector if is_batched else jnp.broadcast_to(vector, (size, *vector.shape))
            for vector, is_batched in zip(vectors, batched, strict=True)
        ]
        return jax.lax.platform_dependent(*rows, cuda=kernel, default=many_elsewhere), (True,) * len(widths)

    return function


def gpu_kernel(
    program: Program, widths: Sequence[int], block: int = BLOCK, warps: int = WARPS
) -> Callable[..., tuple[Array, ...]]:
    """The program over arrays [samples, width], as one Pallas kernel.

    A thread reads the few numbers of its sample, which lie side by side: what a group of threads reads is in whole
    lines of the cache, so that transposing the arrays first would only move them through memory once more.

    Args:
      program: see `fused`.
      widths: see `fused`.
      block: samples in a block; a power of 2.
      warps: groups of 32 threads in a block.
    """

    def batched(*rows: Array) -> tuple[Array, ...]:
        count, dtype = rows[0].shape[0], rows[0].dtype

        def kernel(*refs: Any) -> None:
            # Columns are named by arrays, because interpret mode refuses plain numbers.
            inside = pl.program_id(0) * block + jnp.arange(block) < count  # the last block may stick out
            inputs = [
                [triton.load(ref.at[:, jnp.int32(k)], mask=inside, other=0.0) for k in range(ref.shape[1])]
                for ref in refs[: len(rows)]
            ]
            for ref, scalars in zip(refs[len(rows) :], program(*inputs), strict=True):
                for k, value in enumerate(scalars):
                    triton.store(ref.at[:, jnp.int32(k)], jnp.broadcast_to(value, block).astype(dtype), mask=inside)

        return tuple(
            pl.pallas_call(
                kernel,
                out_shape=[jax.ShapeDtypeStruct((count, width), dtype) for width in widths],
                grid=(pl.cdiv(count, block),),
                in_specs=[_side_by_side(block, x.shape[1]) for x in rows],
                out_specs=[_side_by_side(block, width) for width in widths],
                compiler_params=triton.CompilerParams(num_warps=warps, num_stages=1),
            )(*rows)
        )

    return batched


def _side_by_side(block: int, width: int) -> pl.BlockSpec:
    return pl.BlockSpec((block, width), lambda i: (i, 0))
