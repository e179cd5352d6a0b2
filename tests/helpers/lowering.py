"""Programs for a GPU that is not there."""

import contextlib

import jax


def gpu_program(function, *arguments):
    """The text of a jitted function's program for NVIDIA GPUs."""
    kind = getattr(jax.sharding, "AbstractDevice", None)  # from JAX 0.12 on Pallas asks which GPU
    there = contextlib.nullcontext()
    if kind is not None:
        device = kind(device_kind="NVIDIA H200", num_cores=132, platform="gpu")
        there = jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), (), abstract_device=device))
    with there:
        return function.trace(*arguments).lower(lowering_platforms=("cuda",)).as_text()
