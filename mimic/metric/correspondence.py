"""Correspondence matrices W [n, n_hat]: how strongly each pair of links of two embodiments corresponds."""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.arms.chain_match import matched_chains
from mimic.arms.embodiment import Embodiment


def hard_correspondence(distances: Float[Array, "expert learner"]) -> Float[Array, "expert learner"]:
    """1 at the nearest learner link of each expert link, plus 1 at the nearest expert link of each learner link.

    W12 + W21 of the paper. The first index wins a tie. Constant under differentiation.

    Args:
      distances: D' [n, n_hat], see `link_distances`.
    """
    n, n_hat = distances.shape
    nearest_learner = jnp.argmin(distances, axis=1)[:, None] == jnp.arange(n_hat)
    nearest_expert = jnp.argmin(distances, axis=0)[None, :] == jnp.arange(n)[:, None]
    return jax.lax.stop_gradient(nearest_learner.astype(distances.dtype) + nearest_expert.astype(distances.dtype))


def soft_correspondence(distances: Float[Array, "expert learner"], *, xi: ArrayLike) -> Float[Array, "expert learner"]:
    """Softmax of xi D' over each row, plus softmax of xi D' over each column (paper).

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
    """Static correspondence by the overlap of links along their chains, with the same weight for each link (paper).

    Both chains are mapped onto [0, 1]. Links i and j overlap there by a length o_ij, and W_ij = o_ij / l_i + o_ij / l_j
    with the link lengths l. Each row of the first term and each column of the second sums to 1. For two equal arms W is
    2 I. In trees o_ij is the sum over the pairs of corresponding chains, see
    `matched_chains`.

    Args:
      expert: n links.
      learner: n_hat links.

    Raises:
      ValueError: trees whose chains do not match.
    """
    overlap, (length_a, length_b), numpy = _overlaps(expert, learner)
    return _array(overlap / length_a[:, None] + overlap / length_b[None, :])


def arc_length_correspondence(
    expert: Embodiment | ArmArrays, learner: Embodiment | ArmArrays
) -> Float[Array, "expert learner"]:
    """Static correspondence by arc length: W_ij = n n_hat o_ij, with o_ij as in `overlap_correspondence`.

    The mean of W o D' is then the integral of the pair distance along both arms: links count by their length, and
    cutting a straight link in two changes nothing. For two equal arms of n links W is n^2 diag(l) / sum(l). For
    trees it is the mean over the pairs of corresponding chains; a link that several have in common counts in each.

    Args:
      expert: n links, or an arm as data.
      learner: n_hat links, or an arm as data if the expert is one; W is 0 for its empty slots of links.

    Raises:
      ValueError: trees whose chains do not match.
    """
    if isinstance(expert, ArmArrays) or isinstance(learner, ArmArrays):
        overlap, numpy = overlaps_of_chains(expert.link_length, learner.link_length, jnp)[0], jnp  # type: ignore[union-attr]
    else:
        overlap, _, numpy = _overlaps(expert, learner)
    return _array(overlap.size * overlap / numpy.sum(overlap))


def _array(values: Any) -> Array:
    """A JAX array; NumPy's are rounded by NumPy, because `jnp.asarray` compiles a function that rounds."""
    return jnp.asarray(values.astype(jax.dtypes.canonicalize_dtype(values.dtype)))


def _overlaps(expert: Embodiment, learner: Embodiment) -> tuple[Any, Any, ModuleType]:
    """Overlap of each pair of links on [0, 1], [n, n_hat]; the links' lengths there; and the array library.

    In trees, overlaps are summed over pairs of chains, and so are the lengths.
    """
    arms = expert, learner
    is_constant = all(isinstance(leaf, np.ndarray) for arm in arms for leaf in (arm.link_lengths, arm.segment_start))
    numpy = np if is_constant else jnp
    link_lengths = [_path_lengths(arm, numpy) for arm in arms]
    pairs = matched_chains(expert.chain_names, learner.chain_names)
    if len(expert.chains) == len(learner.chains) == 1:
        return *overlaps_of_chains(link_lengths[0], link_lengths[1], numpy), numpy
    shape = expert.num_links, learner.num_links
    overlap, sums = numpy.zeros(shape), [numpy.zeros(size) for size in shape]
    for pair in pairs:
        places = [np.eye(arm.num_links)[:, np.array(arm.chains[i])] for arm, i in zip(arms, pair, strict=True)]
        of_chains = [length[np.array(arm.chains[i])] for arm, i, length in zip(arms, pair, link_lengths, strict=True)]
        own_overlap, own_lengths = overlaps_of_chains(of_chains[0], of_chains[1], numpy)
        overlap = overlap + _placed(places[1], _placed(places[0], own_overlap, numpy).T, numpy).T
        sums = [
            total + _placed(place, own[:, None], numpy)[:, 0]
            for total, place, own in zip(sums, places, own_lengths, strict=True)
        ]
    unmatched = [numpy.where(total > 0, total, 1) for total in sums]  # links of chains without a counterpart
    return overlap, unmatched, numpy


def _placed(places: np.ndarray, rows: Any, numpy: ModuleType) -> Any:
    """Rows of a chain's links at the rows of all links; elementwise, so that nothing is rounded to TF32."""
    return numpy.sum(places[:, :, None] * rows[None], axis=1)


def overlaps_of_chains(lengths_a: Any, lengths_b: Any, numpy: ModuleType) -> tuple[Any, Any]:
    """Overlap of each pair of links of two chains, both on [0, 1], and the links' lengths there."""
    (start_a, end_a), (start_b, end_b) = (_on_unit_interval(length, numpy) for length in (lengths_a, lengths_b))
    overlap = numpy.minimum(end_a[:, None], end_b[None, :]) - numpy.maximum(start_a[:, None], start_b[None, :])
    # Overlaps of neighbours that only touch are rounding errors.
    rounding = 4 * sum(overlap.shape) * numpy.finfo(overlap.dtype).eps
    return numpy.where(overlap > rounding, overlap, 0), (end_a - start_a, end_b - start_b)


def _path_lengths(arm: Embodiment, numpy: ModuleType) -> Any:
    """Length of each link along the centre line, [num_links]."""
    if len(arm.segment_link) == arm.num_links:
        return arm.link_lengths
    segments = numpy.sqrt(numpy.sum((arm.segment_end - arm.segment_start) ** 2, axis=1))
    belongs = np.arange(arm.num_links)[:, None] == np.array(arm.segment_link)
    return numpy.sum(numpy.where(belongs, segments, 0), axis=1)


def _on_unit_interval(lengths: Float[Any, " n"], numpy: ModuleType) -> tuple[Any, Any]:
    """Start and end of each link on a chain of length 1."""
    ends = numpy.cumsum(lengths) / numpy.sum(lengths)
    return numpy.concatenate([numpy.zeros(1, ends.dtype), ends[:-1]]), ends
