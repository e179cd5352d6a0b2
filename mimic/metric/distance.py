"""Distance between two embodiments: distances of link pairs, their weights, and the reduction to one number."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

from mimic.base import spatial
from mimic.base.batches import over_batch
from mimic.base.config import check_choice
from mimic.base.ranges import check_ranges, weight_number
from mimic.metric.hand import NO_HAND, HandWeights, hand_distance, hand_factors
from mimic.metric.kinematics import LinkStates

RotationMeasure = Literal["cosine", "angle"]
Reduction = Literal["mean", "frobenius"]
ROTATION_MEASURES = ("cosine", "angle")
REDUCTIONS = ("mean", "frobenius")

_MAX_MATRIX = 1e6  # value of a correspondence
PARTS = ("translation", "rotation", "linear_velocity", "angular_velocity")


@struct.dataclass
class DistanceWeights:
    """Weights of the parts of the pair distance (paper, eq. 19): numbers, or arrays that broadcast to [n, n_hat]."""

    translation: Any = weight_number(0.0)
    rotation: Any = weight_number(1.0)
    linear_velocity: Any = weight_number(0.0)
    angular_velocity: Any = weight_number(0.0)


PAPER_WEIGHTS = DistanceWeights(translation=0.0, rotation=1.0, linear_velocity=0.001, angular_velocity=0.01)
"""The weights of all dynamic simulations in the paper."""


@struct.dataclass
class PairDistances:
    """Unweighted parts of the distance between two links: chain lengths, rad, chain lengths/s, rad/s."""

    translation: Float[Array, "*pairs"]
    rotation: Float[Array, "*pairs"]
    linear_velocity: Float[Array, "*pairs"]
    angular_velocity: Float[Array, "*pairs"]


@dataclasses.dataclass(frozen=True)
class LinkDistance:
    """An own distance between two links, in place of weights: it replaces the weighted sum of the parts.

    Attributes:
      function: (state of an expert link, state of a learner link) -> distance, at least 0; `LinkStates` of one link,
        [3] each. It must be differentiable, also where the links match.
    """

    function: Callable[[LinkStates, LinkStates], Float[Array, ""]]


Weights = DistanceWeights | Callable[[PairDistances], DistanceWeights] | LinkDistance
Correspondence = (
    Real[ArrayLike, "expert learner"] | Callable[[Float[Array, "expert learner"]], Float[Array, "expert learner"]]
)


def adaptive_weights(distances: PairDistances) -> DistanceWeights:
    """Weights that balance translation and rotation: a_tr = d_tr, a_rot = (2/pi)(2 - d_tr) (paper, eq. 24)."""
    translation = distances.translation
    return DistanceWeights(translation=translation, rotation=2 / jnp.pi * (2 - translation))


def rotation_distance(
    direction_a: Float[Array, "3"], direction_b: Float[Array, "3"], measure: RotationMeasure = "cosine"
) -> Float[Array, ""]:
    """Angle beta between two link directions, in [0, pi].

    Args:
      direction_a: unit x-axis of the first link's frame, in the base frame.
      direction_b: the same for the second link.
      measure: "cosine" is the smooth (pi/2)(1 - cos beta) (paper, eq. 17), "angle" is beta itself (paper, eq. 15).

    Raises:
      ValueError: an unknown measure.
    """
    check_choice("rotation", measure, ROTATION_MEASURES)
    a, b = spatial.vector(direction_a), spatial.vector(direction_b)
    if measure == "angle":  # arctan2, because the derivative of arccos is infinite at a match
        return jnp.arctan2(spatial.norm(spatial.cross(a, b)), spatial.dot(a, b))
    # 1 - cos beta = |a - b|^2 / 2 for unit vectors; this form is exactly 0 at a match
    difference = spatial.subtract(a, b)
    return 0.25 * jnp.pi * spatial.dot(difference, difference)


def link_distances(
    expert_states: LinkStates, learner_states: LinkStates, weights: Weights, *, rotation: RotationMeasure = "cosine"
) -> Float[Array, "*batch expert learner"]:
    """Matrix D' of the distances between each link of the expert and each link of the learner (paper, eqs. 8, 19).

    Args:
      expert_states: link states of the expert; normalized, to compare arms of different size. Batch axes before those
        of a sample broadcast with those of the learner.
      learner_states: link states of the learner.
      weights: constants, or a function of the unweighted distances of one pair, such as `adaptive_weights`; or a
        `LinkDistance`.
      rotation: the rotational measure, see `rotation_distance`.

    Raises:
      ValueError: an unknown measure, a weight out of range, or one on a part that candidate points lack.
    """
    check_choice("rotation", rotation, ROTATION_MEASURES)
    _check_weights(weights)
    distances = functools.partial(_link_distances, weights, rotation)
    return over_batch(distances, expert_states, learner_states, axes=2)


def _link_distances(
    weights: Weights, rotation: RotationMeasure, expert_states: LinkStates, learner_states: LinkStates
) -> Float[Array, "expert learner"]:
    expert_states, learner_states = (
        dataclasses.replace(states, hand=None) for states in (expert_states, learner_states)
    )
    if isinstance(weights, LinkDistance):
        own = jax.vmap(jax.vmap(weights.function, in_axes=(None, 0)), in_axes=(0, None))
        return own(expert_states, learner_states)
    if not callable(weights):
        _check_candidate_points(expert_states, learner_states, weights)
    over_learner = jax.vmap(lambda a, b: pair_distances(a, b, rotation), in_axes=(None, 0))
    parts = jax.vmap(over_learner, in_axes=(0, None))(expert_states, learner_states)
    alpha = jax.vmap(jax.vmap(weights))(parts) if callable(weights) else weights
    total: Any = 0.0
    for part in PARTS:
        distances = getattr(parts, part)
        weight = _weight(part, getattr(alpha, part), distances)  # a constant 0 costs nothing, in time and in NaNs
        total = spatial.plus(total, spatial.times(weight, distances))
    return jnp.broadcast_to(jnp.asarray(total, parts.translation.dtype), parts.translation.shape)


@dataclasses.dataclass(frozen=True, eq=False)
class Metric:
    """The metric between two embodiments. Calling it with their link states returns the embodiment distance.

    Attributes:
      correspondence: W [n, n_hat], or a function of the link distances that returns W, such as `hard_correspondence`.
      weights: see `link_distances`.
      rotation: see `link_distances`.
      reduction: "mean" of all n n_hat entries of W o D' (paper), or their "frobenius" norm.
      hand_weights: of the distance of the hands, which is added, see `hand_distance`.

    Raises:
      ValueError: an unknown rotation measure or reduction, or an entry of W or a weight out of range.
    """

    correspondence: Correspondence
    weights: Weights
    rotation: RotationMeasure = "cosine"
    reduction: Reduction = "mean"
    hand_weights: HandWeights = NO_HAND

    def __post_init__(self) -> None:
        check_choice("rotation", self.rotation, ROTATION_MEASURES)
        check_choice("reduction", self.reduction, REDUCTIONS)
        if not callable(self.correspondence) and not isinstance(self.correspondence, Tracer):
            check_matrix("correspondence", np.asarray(self.correspondence))
        _check_weights(self.weights)
        check_ranges(self.hand_weights, "hand_weights.")

    @property
    def arguments(self) -> dict[str, Any]:
        """The attributes as keyword arguments, for functions that take the parts of a metric."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @property
    def is_static(self) -> bool:
        """Whether it is a weighted sum with "cosine"; such a metric has closed forms."""
        return self.is_weighted_sum and self.rotation == "cosine"

    @property
    def is_weighted_sum(self) -> bool:
        """Whether W and weights are constant, the reduction "mean", and "cosine" the measure where hands count."""
        constant = not callable(self.correspondence) and isinstance(self.weights, DistanceWeights)
        return constant and self.reduction == "mean" and (self.rotation == "cosine" or self.hand_weights.are_zero)

    def __call__(self, expert_states: LinkStates, learner_states: LinkStates) -> Float[Array, "*batch"]:
        """See `embodiment_distance`."""
        of_links = over_batch(self.reduced, self.link_distances(expert_states, learner_states), axes=2)
        if self.hand_weights.are_zero:
            return of_links
        distance = functools.partial(hand_distance, weights=self.hand_weights)
        return of_links + over_batch(distance, expert_states.hand, learner_states.hand, axes=2)

    def factors(self, expert_hands: int = 0, learner_hands: int = 0) -> Float[Any, "4 rows learner_rows"]:
        """Factor of each of `PARTS` of each pair's distance, of a weighted sum; NumPy where all is constant.

        Args:
          expert_hands: hands of the expert, whose axes are rows after those of its links, see `hand_factors`.
          learner_hands: likewise.
        """
        assert isinstance(self.weights, DistanceWeights) and not callable(self.correspondence)
        is_constant = not any(isinstance(x, Tracer) for x in jax.tree.leaves((self.correspondence, self.weights)))
        numpy = np if is_constant else jnp
        matrix = numpy.asarray(self.correspondence)
        weights = [numpy.broadcast_to(numpy.asarray(getattr(self.weights, part)), matrix.shape) for part in PARTS]
        of_links = numpy.stack(weights) * matrix / matrix.size
        if self.hand_weights.are_zero:
            return of_links
        of_hands = hand_factors(self.hand_weights, expert_hands, learner_hands)
        numpy = np if isinstance(of_links, np.ndarray) and isinstance(of_hands, np.ndarray) else jnp
        (n, n_hat), (m, m_hat) = of_links.shape[1:], of_hands.shape[1:]
        corner, other = numpy.zeros((len(PARTS), n, m_hat)), numpy.zeros((len(PARTS), m, n_hat))
        above, below = (numpy.concatenate(x, axis=2) for x in ((of_links, corner), (other, of_hands)))
        return numpy.concatenate([above, below], axis=1)

    def link_distances(
        self, expert_states: LinkStates, learner_states: LinkStates
    ) -> Float[Array, "*batch expert learner"]:
        """See `link_distances`."""
        return link_distances(expert_states, learner_states, self.weights, rotation=self.rotation)

    def matrix(self, distances: Float[Array, "expert learner"]) -> Float[Array, "expert learner"]:
        """W for these link distances.

        Raises:
          ValueError: W has another shape than the distances.
        """
        matrix = self.correspondence(distances) if callable(self.correspondence) else self.correspondence
        matrix = jnp.asarray(matrix, distances.dtype)
        if matrix.shape != distances.shape:
            raise ValueError(
                f"correspondence: expected shape {distances.shape} (expert links, learner links), got {matrix.shape}"
            )
        return matrix

    def reduced(self, distances: Float[Array, "expert learner"]) -> Float[Array, ""]:
        """Reduction of the link distances to one number."""
        weighted = self.matrix(distances) * distances
        if self.reduction == "mean":
            return jnp.mean(weighted)
        return spatial.safe_sqrt(jnp.sum(weighted * weighted))


def embodiment_distance(
    expert_states: LinkStates,
    learner_states: LinkStates,
    correspondence: Correspondence,
    weights: Weights,
    *,
    rotation: RotationMeasure = "cosine",
    reduction: Reduction = "mean",
    hand_weights: HandWeights = NO_HAND,
) -> Float[Array, "*batch"]:
    """Distance between two embodiments: the reduction of W o D' to one number (paper, Algorithm 1).

    Args:
      expert_states: link states of the expert. Batch axes before those of a sample broadcast with those of the learner.
      learner_states: link states of the learner.
      correspondence: see `Metric`.
      weights: see `link_distances`.
      rotation: see `link_distances`.
      reduction: see `Metric`.
      hand_weights: see `Metric`.

    Raises:
      ValueError: W has another shape, an unknown measure or reduction, or what `link_distances` rejects.
    """
    return Metric(correspondence, weights, rotation, reduction, hand_weights)(expert_states, learner_states)


def pair_distances(a: LinkStates, b: LinkStates, measure: RotationMeasure) -> PairDistances:
    """Parts of the distance between two links (paper, the terms of eq. 19), in the units of `PairDistances`.

    Args:
      a: state of one link, each [3]; the part of a field that is None is 0.
      b: state of the other link.
      measure: see `rotation_distance`.
    """
    zero = jnp.zeros((), a.position.dtype)  # for the parts that candidate points lack

    def difference(x: Array | None, y: Array | None) -> Array:
        is_missing = x is None or y is None
        return zero if is_missing else spatial.norm(spatial.subtract(spatial.vector(x), spatial.vector(y)))

    def angle(x: Array | None, y: Array | None) -> Array:
        return zero if x is None or y is None else rotation_distance(x, y, measure)

    return PairDistances(
        translation=difference(a.position, b.position),
        rotation=angle(a.direction, b.direction),
        linear_velocity=difference(a.linear_velocity, b.linear_velocity),
        angular_velocity=difference(a.angular_velocity, b.angular_velocity),
    )


def _weight(part: str, value: Any, distances: Array) -> Any:
    """A weight as a Python float where it is a number, else broadcast to the shape of the distances."""
    if isinstance(value, int | float | np.number):
        return float(value)
    weight = jnp.asarray(value, distances.dtype)
    try:
        return jnp.broadcast_to(weight, distances.shape)
    except ValueError:
        raise ValueError(
            f"weights: expected {part} to broadcast to {distances.shape} (expert links, learner links), "
            f"got shape {weight.shape}"
        ) from None


def check_matrix(name: str, matrix: np.ndarray) -> None:
    """Raises a ValueError that starts with the name for a W of anything but finite numbers from 0 on."""
    is_real = matrix.dtype.kind in "biuf"
    if is_real and np.all((matrix >= 0) & (matrix <= _MAX_MATRIX)):
        return
    if not is_real or not np.all(np.isfinite(matrix)):
        raise ValueError(f"{name}: expected finite numbers")
    raise ValueError(f"{name}: expected numbers from 0 to {_MAX_MATRIX:g}, got {matrix.min():g} to {matrix.max():g}")


def _check_weights(weights: Any) -> None:
    if isinstance(weights, DistanceWeights):  # not when they are made: their gradients have the same type
        check_ranges(weights, "weights.")
    elif not callable(weights) and not isinstance(weights, LinkDistance):
        raise ValueError(f"weights: expected DistanceWeights, a function or a LinkDistance, got {weights!r:.80}")


def _check_candidate_points(a: LinkStates, b: LinkStates, weights: DistanceWeights) -> None:
    for part, field in (("rotation", "direction"), ("angular_velocity", "angular_velocity")):
        weight = getattr(weights, part)
        missing = getattr(a, field) is None or getattr(b, field) is None
        if missing and not isinstance(weight, Tracer) and np.any(np.asarray(weight) != 0):
            raise ValueError(f"weights: candidate points have no {field}, so {part} must weigh 0, got {weight}")
