"""The paper's result for two-link arms: which measures have one minimum, and which have more."""

import numpy as np
import pytest

from mimic.arms.embodiment import planar_arm
from mimic.metric.correspondence import hard_correspondence, overlap_correspondence
from mimic.metric.distance import DistanceWeights, adaptive_weights
from mimic.metric.landscape import distance_landscape, local_minima

ARM = planar_arm([0.5, 0.5])
EXPERT_POSE = np.array([1.5, -1.5])
MEASURES = {
    "state-dependent": (hard_correspondence, DistanceWeights(translation=1.5, rotation=1.0)),
    "adaptive": (hard_correspondence, adaptive_weights),
    "rotation only": (overlap_correspondence(ARM, ARM), DistanceWeights(translation=0.0, rotation=1.0)),
}


def test_only_the_static_rotational_measure_has_one_minimum():
    counts, resolution = {}, 90
    for name, (correspondence, weights) in MEASURES.items():
        landscape = distance_landscape(ARM, ARM, EXPERT_POSE, correspondence, weights, resolution=resolution)
        minima = local_minima(landscape.distance)
        counts[name] = len(minima)
        nearest = minima[np.argmin([landscape.distance[i, j] for i, j in minima])]
        spacing = 2 * np.pi / resolution
        np.testing.assert_allclose(landscape.angles[nearest], EXPERT_POSE, atol=spacing)  # the match is found
    assert counts["rotation only"] == 1
    assert counts["state-dependent"] > 1 and counts["adaptive"] > 1


def test_minima_are_counted_across_the_seam():
    angles = np.linspace(-np.pi, np.pi, 40, endpoint=False)
    bowl = -np.cos(angles)[:, None] - np.cos(angles - np.pi)[None, :]
    np.testing.assert_array_equal(local_minima(bowl), [[20, 0]])
    assert len(local_minima(-np.cos(2 * angles)[:, None] - np.cos(angles)[None, :])) == 2


@pytest.mark.usefixtures("unchecked")
def test_bad_input_is_rejected():
    with pytest.raises(ValueError, match="learner: expected 2 joints, got 3"):
        distance_landscape(ARM, planar_arm([1, 1, 1]), EXPERT_POSE, hard_correspondence, adaptive_weights)
    with pytest.raises(ValueError, match="resolution: expected at least 3"):
        distance_landscape(ARM, ARM, EXPERT_POSE, hard_correspondence, adaptive_weights, resolution=2)


def test_a_plateau_has_no_minimum():
    distance = np.ones((4, 4))
    assert len(local_minima(distance)) == 0
    distance[1, 0] = 0.0
    assert local_minima(distance).tolist() == [[1, 0]]
