"""Which links of two embodiments belong together: correspondence matrices W [n, n_hat]."""

from types import ModuleType
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.arms.embodiment import Embodiment

LinkLengths = Literal["path", "chord"]


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


def overlap_correspondence(
    expert: Embodiment, learner: Embodiment, *, lengths: LinkLengths = "path"
) -> Float[Array, "expert learner"]:
    """Static correspondence by where the links lie along their chains; every link counts the same (paper).

    Both chains are laid on [0, 1]; with o_ij the length that link i and link j share there, W_ij = o_ij / l_i +
    o_ij / l_j, so that every row of the first part and every column of the second sums to 1. An arm with itself gives
    2 I.

    Args:
      expert: n links.
      learner: n_hat links.
      lengths: what is laid out: each link's "path" along the centre line, or its "chord" from start to end. They differ
        for merged links alone.
    """
    shared, (length_a, length_b), numpy = _shared_lengths(expert, learner, lengths)
    return jnp.asarray(shared / length_a[:, None] + shared / length_b[None, :])


def arc_length_correspondence(expert: Embodiment, learner: Embodiment) -> Float[Array, "expert learner"]:
    """Static correspondence by common arc length: W_ij = n n_hat o_ij, with o_ij as in `overlap_correspondence`.

    The mean of W o D' is then the integral of the pair distance along both arms: a link counts by its length, and
    nothing changes when a straight link is cut in two. An arm of n links with itself gives n^2 diag(l) / sum(l).

    Args:
      expert: n links.
      learner: n_hat links.
    """
    shared, _, numpy = _shared_lengths(expert, learner, "path")
    return jnp.asarray(expert.num_links * learner.num_links * shared / numpy.sum(shared))


def _shared_lengths(expert: Embodiment, learner: Embodiment, lengths: LinkLengths) -> tuple[Any, Any, ModuleType]:
    """Length that each pair of links shares on [0, 1], [n, n_hat]; the links' own lengths there; and NumPy or JAX's."""
    arms = expert, learner
    is_known = all(isinstance(leaf, np.ndarray) for arm in arms for leaf in (arm.link_lengths, arm.segment_start))
    numpy = np if is_known else jnp
    own = [arm.link_lengths if lengths == "chord" else _path_lengths(arm, numpy) for arm in arms]
    (start_a, end_a), (start_b, end_b) = (_laid_on_unit_interval(length, numpy) for length in own)
    shared = numpy.minimum(end_a[:, None], end_b[None, :]) - numpy.maximum(start_a[:, None], start_b[None, :])
    # Neighbours that touch share rounding errors, not length.
    rounding = 4 * sum(shared.shape) * numpy.finfo(shared.dtype).eps
    return numpy.where(shared > rounding, shared, 0), (end_a - start_a, end_b - start_b), numpy


def _path_lengths(arm: Embodiment, numpy: ModuleType) -> Any:
    """Length of each link along the centre line, [num_links]; the link's own where it is a single segment."""
    if len(arm.segment_link) == arm.num_links:
        return arm.link_lengths
    segments = numpy.sqrt(numpy.sum((arm.segment_end - arm.segment_start) ** 2, axis=1))
    belongs = np.arange(arm.num_links)[:, None] == np.array(arm.segment_link)
    return numpy.sum(numpy.where(belongs, segments, 0), axis=1)


def _laid_on_unit_interval(lengths: Float[Any, " n"], numpy: ModuleType) -> tuple[Any, Any]:
    """Where each link starts and ends on its chain of length 1."""
    ends = numpy.cumsum(lengths) / numpy.sum(lengths)
    return numpy.concatenate([numpy.zeros(1, ends.dtype), ends[:-1]]), ends
