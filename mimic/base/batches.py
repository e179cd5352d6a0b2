"""Batches: leading axes of arguments, for functions of one sample."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from mimic.base.compilation import has_tracer

_FLOATS = np.float32, np.float64


def over_batch(function: Callable[..., Any], *arguments: Any, axes: int) -> Any:
    """Calls a function of one sample for each entry of the leading axes, which broadcast, by `jax.vmap`.

    Args:
      function: of arguments without batch axes.
      *arguments: pytrees of arrays.
      axes: number of the last axes of each array that belong to a sample.

    Returns:
      The function's arrays, with the batch axes before theirs.
    """
    batch = jnp.broadcast_shapes(*(leaf.shape[: leaf.ndim - axes] for leaf in jax.tree.leaves(arguments)))
    if not batch:
        return function(*arguments)

    def rows(leaf: Any) -> Any:
        sample = leaf.shape[leaf.ndim - axes :]
        return jnp.broadcast_to(leaf, (*batch, *sample)).reshape(-1, *sample)

    results = jax.vmap(function)(*jax.tree.map(rows, arguments))
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), results)


def floats(values: ArrayLike, name: str) -> Any:
    """The values as floating-point numbers of 32 bits or more: a JAX array where they are one, else a NumPy array.

    Raises:
      ValueError: rows of different lengths, or entries that are no real numbers.
    """
    array: Any = values
    if (type(array) is np.ndarray or isinstance(array, jax.Array)) and array.dtype in _FLOATS:
        return array  # at once: a live pose takes 0.3 ms
    try:
        array = jnp.asarray(values) if has_tracer(values) else values
        array = array if isinstance(array, jax.Array) else np.asarray(array)
    except ValueError:
        raise ValueError(f"{name}: expected rows of one length, got {values!r:.80}") from None
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array if array.dtype.itemsize >= 4 else array.astype(np.float32)
    if not jnp.issubdtype(array.dtype, jnp.integer) and array.dtype != bool:
        raise ValueError(f"{name}: expected real numbers, got {array.dtype} in {values!r:.80}")
    return array.astype(jnp.result_type(float))
