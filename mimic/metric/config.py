"""The config of a metric, and the metric that it describes."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from mimic.arms.chain import LINKS
from mimic.arms.chain_match import matched_chains
from mimic.arms.embodiment import Embodiment, without_hands
from mimic.arms.link_match import LinkMatch
from mimic.base import registry
from mimic.base.config import check_choice
from mimic.base.ranges import check_ranges, weight_number
from mimic.metric.correspondence import (
    arc_length_correspondence,
    hard_correspondence,
    overlap_correspondence,
    soft_correspondence,
)
from mimic.metric.distance import (
    REDUCTIONS,
    ROTATION_MEASURES,
    Correspondence,
    DistanceWeights,
    LinkDistance,
    Metric,
    PairDistances,
    Reduction,
    RotationMeasure,
    Weights,
    adaptive_weights,
    check_matrix,
)
from mimic.metric.hand import NO_HAND, HandWeights

CORRESPONDENCES = ("arc_length", "overlap", "hard", "soft")
SOFT_SHARPNESS = -10.0  # xi of the correspondence "soft"
registry.reserve("correspondence", CORRESPONDENCES)


@dataclasses.dataclass(frozen=True)
class MetricConfig:
    """Config of the embodiment distance. `benchmarks.similarity` chose the defaults: see docs/similarity.md.

    Attributes:
      translation, rotation, linear_velocity, angular_velocity: weights; per chain length, rad, and their rates.
      hand_rotation, hand_position: weights of the hands, see `HandWeights`; without effect where
        the hand of an arm is not known.
      adaptive: replace the weights of translation and rotation by the paper's distance-dependent ones.
      rotation_measure: "cosine" or "angle".
      links: "kept" (a locked joint removes no link) or "merged" (its two links become one chord; paper).
      correspondence: "arc_length" or "overlap" (static), "hard" or "soft" (by distance), or a registered name.
      link_distance: a registered function of two links, in place of the weighted parts; none where empty.
      reduction: "mean" or "frobenius".
    """

    translation: float = weight_number(1.0)
    rotation: float = weight_number(1.0)
    linear_velocity: float = weight_number(0.001)
    angular_velocity: float = weight_number(0.01)
    hand_rotation: float = weight_number(0.02)
    hand_position: float = weight_number(0.0)
    adaptive: bool = False
    rotation_measure: str = "cosine"
    correspondence: str = "arc_length"
    reduction: str = "mean"
    links: str = "kept"
    link_distance: str = ""

    def __post_init__(self) -> None:
        check_choice("links", self.links, LINKS)
        registry.check("correspondence", self.correspondence, "correspondence")
        if self.link_distance:
            registry.check("link_distance", self.link_distance, "link_distance")
        check_choice("rotation_measure", self.rotation_measure, ROTATION_MEASURES)
        check_choice("reduction", self.reduction, REDUCTIONS)
        check_ranges(self, "metric.")

    def make_weights(self) -> Weights:
        """The weights: constants, a function of the distances, or an own distance between links."""
        if self.link_distance:
            return LinkDistance(registry.find("link_distance", self.link_distance, "metric.link_distance"))
        velocities = {"linear_velocity": self.linear_velocity, "angular_velocity": self.angular_velocity}
        if self.adaptive:
            return partial(_adaptive_weights, **velocities)
        return DistanceWeights(self.translation, self.rotation, **velocities)

    def make_correspondence(self, expert: Embodiment, learner: Embodiment) -> Correspondence:
        """W, or a function of the link distances that returns it.

        Raises:
          ValueError: a matrix of a registered function that does not fit the arms.
        """
        constructors: dict[str, Callable[[], Correspondence]] = {
            "arc_length": lambda: arc_length_correspondence(expert, learner),
            "overlap": lambda: overlap_correspondence(expert, learner),
            "hard": lambda: hard_correspondence,
            "soft": lambda: partial(soft_correspondence, xi=SOFT_SHARPNESS),
        }
        if self.correspondence in constructors:
            return constructors[self.correspondence]()
        made: Any = registry.find("correspondence", self.correspondence, "metric.correspondence")(expert, learner)
        if callable(made):
            return cast(Correspondence, made)
        return _checked_matrix(made, expert, learner, repr(self.correspondence))

    def build(self, expert: Embodiment, learner: Embodiment) -> Metric:
        """The metric between two arms."""
        correspondence = self.make_correspondence(expert, learner)
        rotation, reduction = cast(RotationMeasure, self.rotation_measure), cast(Reduction, self.reduction)
        return Metric(correspondence, self.make_weights(), rotation, reduction, self._hand_weights(expert, learner))

    def compared(self, arm: Embodiment) -> Embodiment:
        """The arm with what this metric compares: without hands where they have no weight."""
        return arm if self.hand_rotation or self.hand_position else without_hands(arm)

    def _hand_weights(self, expert: Embodiment, learner: Embodiment) -> HandWeights:
        weights = HandWeights(self.hand_rotation, self.hand_position)
        if weights.are_zero or not expert.hand_joint or not learner.hand_joint:
            return NO_HAND
        pairs = matched_chains(expert.chain_names, learner.chain_names)
        return dataclasses.replace(weights, pairs=pairs)

    def link_fractions(self, expert: Embodiment, learner: Embodiment) -> Float[np.ndarray, "expert learner"]:
        """Fraction of each expert link in the target of a learner link; columns sum to 1.

        From the static correspondence; equal fractions where W depends on the state. A column of W that is 0 stays 0.
        """
        correspondence = self.make_correspondence(expert, learner)
        shape = expert.num_links, learner.num_links
        matrix = np.ones(shape) if callable(correspondence) else np.asarray(correspondence)
        sums = matrix.sum(axis=0)
        return matrix / np.where(sums == 0, 1.0, sums)

    def match_links(self, expert: Embodiment, learner: Embodiment) -> LinkMatch:
        """Which links correspond, for pictures; where W depends on the state, those of the arc length."""
        is_static = not callable(self.make_correspondence(expert, learner))
        metric = self if is_static else dataclasses.replace(self, correspondence="arc_length")
        return LinkMatch(expert, learner, metric.link_fractions(expert, learner))


def check_metric(config: MetricConfig) -> DistanceWeights:
    """The weights of a metric between any arms.

    Raises:
      ValueError: a metric other than constant weights with the correspondence by arc length.
    """
    weights = config.make_weights()
    expected: dict[str, Any] = {"correspondence": "arc_length", "reduction": "mean", "rotation_measure": "cosine"}
    expected |= {"links": "kept", "hand_rotation": 0.0, "hand_position": 0.0}
    different = [f"{key}={getattr(config, key)}" for key, value in expected.items() if getattr(config, key) != value]
    if different or not isinstance(weights, DistanceWeights):
        raise ValueError(
            "metric: expected the default one, with any constant weights, for arms as arrays, got "
            + (", ".join(different) or f"adaptive={config.adaptive}, link_distance={config.link_distance!r}")
        )
    return weights


def _checked_matrix(
    matrix: Any, expert: Embodiment, learner: Embodiment, label: str
) -> Float[np.ndarray, "expert learner"]:
    """W as an array. Raises a ValueError that starts with the label if it does not fit the arms."""
    values, shape = np.asarray(matrix), (expert.num_links, learner.num_links)
    if values.shape != shape:
        raise ValueError(
            f"correspondence: {label}: expected shape {list(shape)}, a row for each expert link "
            f"({', '.join(expert.link_names)}) and a column for each learner link ({', '.join(learner.link_names)}), "
            f"got {list(values.shape)}"
        )
    check_matrix(f"correspondence: {label}", values)
    if not values.any():
        raise ValueError(f"correspondence: {label}: expected numbers above 0, got zeros alone")
    return values.astype(float)


def _adaptive_weights(distances: PairDistances, **velocities: float) -> DistanceWeights:
    """`adaptive_weights` with constant weights on velocities."""
    return dataclasses.replace(adaptive_weights(distances), **velocities)
