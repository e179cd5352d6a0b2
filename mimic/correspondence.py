"""Which links of two embodiments belong together: correspondence matrices W [n, n_hat]."""

import jax
import jax.numpy as jnp
import numpy as np
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


def soft_correspondence(distances: Float[Array, "expert learner"], *, xi: float) -> Float[Array, "expert learner"]:
    """Softmax of xi D' over each row, plus softmax over each column; tends to `hard_correspondence` as xi -> -inf (paper).

    Args:
      distances: D' [n, n_hat], see `link_distances`.
      xi: sharpness, below 0.

    Raises:
      ValueError: xi is not below 0.
    """
    if not isinstance(xi, jax.core.Tracer) and not xi < 0:
        raise ValueError(f"xi: expected a number below 0 (soft minimum), got {xi}")
    return jax.nn.softmax(xi * distances, axis=1) + jax.nn.softmax(xi * distances, axis=0)


def overlap_correspondence(expert: Embodiment, learner: Embodiment) -> Float[Array, "expert learner"]:
    """Static correspondence by where the links lie along their chains.

    Both chains are laid on [0, 1]; with o_ij the length that link i and link j share there, W_ij = o_ij / l_i + o_ij / l_j, so
    every row of the first part and every column of the second sums to 1. An arm with itself gives 2 I.

    Args:
      expert: n links.
      learner: n_hat links.
    """
    start_a, end_a = _laid_on_unit_interval(expert)
    start_b, end_b = _laid_on_unit_interval(learner)
    shared = jnp.minimum(end_a[:, None], end_b[None, :]) - jnp.maximum(start_a[:, None], start_b[None, :])
    shared = jnp.where(shared > 1e-9, shared, 0)  # neighbours that touch share rounding errors, not length
    return shared / (end_a - start_a)[:, None] + shared / (end_b - start_b)[None, :]


def _laid_on_unit_interval(arm: Embodiment) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    numpy = np if isinstance(arm.link_lengths, np.ndarray) else jnp
    ends = numpy.cumsum(arm.link_lengths)
    ends = numpy.concatenate([numpy.zeros(1, ends.dtype), ends]) / ends[-1]
    return jnp.asarray(ends[:-1]), jnp.asarray(ends[1:])
