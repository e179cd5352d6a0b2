"""Batches: leading axes of arguments, for functions of one sample."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


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
