"""Which links of two embodiments belong together: correspondence matrices W [n, n_hat]."""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.embodiment import Embodiment


def hard_correspondence(distances: Float[Array, "expert learner"]) -> Float[Array, "expert learner"]:
    """One for the nearest learner link of each expert link, plus one for the nearest expert link of each learner link.

    The paper's W12 + W21. The first index wins a tie. Constant under differentiation.

    Args:
      distances: D' [n, n_hat], see `link_distances`.
    """
    n, n_hat = distances.shape
    nearest_learner = jnp.argmin(distances, axis=1)[:, None] == jnp.arange(n_hat)
    nearest_expert = jnp.argmin(distances, axis=0)[None, :] == jnp.arange(n)[:, None]
    return jax.lax.stop_gradient(nearest_learner.astype(distances.dtype) + nearest_expert.astype(distances.dtype))


def soft_correspondence(distances: Float[Array, "expert learner"], *, xi: ArrayLike) -> Float[Array, "expert learner"]:
    """Softmax of xi D' over each row plus softmax of it over each column (paper).

    Tends to `hard_correspondence` as xi -> -inf.

    Args:
      distances: D' [n, n_hat], see `link_distances`.
      xi: sharpness, a number below 0.

    Raises:
      ValueError: xi is not a finite number below 0.
    """
    if not isinstance(xi, Tracer) and not (np.ndim(xi) == 0 and -np.inf < float(np.asarray(xi)) < 0):
        raise ValueError(f"xi: expected a finite number below 0, for a soft minimum, got {xi}")
    sharpened = jnp.asarray(xi, distances.dtype) * distances
    return jax.nn.softmax(sharpened, axis=1) + jax.nn.softmax(sharpened, axis=0)


def overlap_correspondence(expert: Embodiment, learner: Embodiment) -> Float[Array, "expert learner"]:
    """Static correspondence by where the links lie along their chains.

    Both chains are laid on [0, 1]; with o_ij the length that link i and link j share there,
    W_ij = o_ij / l_i + o_ij / l_j, so that every row of the first part and every column of the second sums to 1. An arm
    with itself gives 2 I.

    Args:
      expert: n links.
      learner: n_hat links.
    """
    lengths = expert.link_lengths, learner.link_lengths
    numpy = np if all(isinstance(length, np.ndarray) for length in lengths) else jnp
    (start_a, end_a), (start_b, end_b) = (_laid_on_unit_interval(length, numpy) for length in lengths)
    shared = numpy.minimum(end_a[:, None], end_b[None, :]) - numpy.maximum(start_a[:, None], start_b[None, :])
    # Neighbours that touch share rounding errors, not length.
    rounding = 4 * sum(shared.shape) * numpy.finfo(shared.dtype).eps
    shared = numpy.where(shared > rounding, shared, 0)
    return jnp.asarray(shared / (end_a - start_a)[:, None] + shared / (end_b - start_b)[None, :])


def _laid_on_unit_interval(lengths: Float[Any, " n"], numpy: ModuleType) -> tuple[Any, Any]:
    """Where each link starts and ends on its chain of length 1."""
    ends = numpy.cumsum(lengths) / numpy.sum(lengths)
    return numpy.concatenate([numpy.zeros(1, ends.dtype), ends[:-1]]), ends
