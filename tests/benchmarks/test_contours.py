"""The paper's result for two-link arms: which measures have one minimum, and which have more."""

import numpy as np

from benchmarks.figures.poses import ANGLES, distances_of_all_poses, local_minima
from mimic.arms.embodiment import planar_arm
from mimic.metric.correspondence import hard_correspondence, overlap_correspondence
from mimic.metric.distance import DistanceWeights, Metric, adaptive_weights

ARM = planar_arm([0.5, 0.5])
METRICS = {
    "state-dependent": Metric(hard_correspondence, DistanceWeights(translation=1.5, rotation=1.0)),
    "adaptive": Metric(hard_correspondence, adaptive_weights),
    "rotation only": Metric(overlap_correspondence(ARM, ARM), DistanceWeights(translation=0.0, rotation=1.0)),
}


def test_only_the_static_rotational_measure_has_one_minimum():
    counts = {}
    for name, metric in METRICS.items():
        distance = distances_of_all_poses(metric)
        minima = local_minima(distance)
        counts[name] = len(minima)
        nearest = minima[np.argmin([distance[i, j] for i, j in minima])]
        np.testing.assert_allclose(ANGLES[nearest], [1.5, -1.5], atol=ANGLES[1] - ANGLES[0])  # the match is found
    assert counts["rotation only"] == 1
    assert counts["state-dependent"] > 1 and counts["adaptive"] > 1


def test_minima_are_counted_across_the_seam():
    bowl = -np.cos(ANGLES)[:, None] - np.cos(ANGLES - np.pi)[None, :]
    np.testing.assert_array_equal(local_minima(bowl), [[90, 0]])
    assert not len(local_minima(np.ones((4, 4))))
