"""Correspondences and distances of registered functions."""

import numpy as np
import pytest

import mimic
from mimic.metric.config import MetricConfig
from mimic.metric.distance import LinkDistance

EXPERT, LEARNER = mimic.planar_arm([0.5, 0.3, 0.2]), mimic.planar_arm([0.6, 0.4])
MATRIX = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 2.0]])


def states():
    qpos = np.array([0.3, -0.4, 0.8])
    return mimic.link_states(EXPERT, qpos), mimic.link_states(LEARNER, qpos[:2])


def test_a_registered_correspondence_is_a_matrix_or_a_function(own_registry):
    mimic.register("correspondence", "fixed", lambda expert, learner: MATRIX)
    mimic.register("correspondence", "nearest", lambda expert, learner: mimic.hard_correspondence)
    config = MetricConfig(correspondence="fixed", hand_rotation=0.0)
    metric = config.build(EXPERT, LEARNER)
    assert metric.is_static
    np.testing.assert_array_equal(metric.correspondence, MATRIX)
    expected = mimic.embodiment_distance(*states(), MATRIX, config.make_weights())
    np.testing.assert_allclose(metric(*states()), expected, rtol=1e-6)
    np.testing.assert_allclose(config.link_fractions(EXPERT, LEARNER).sum(axis=0), 1.0)
    nearest = MetricConfig(correspondence="nearest").build(EXPERT, LEARNER)
    assert nearest(*states()) == MetricConfig(correspondence="hard").build(EXPERT, LEARNER)(*states())


def test_a_link_without_a_partner_has_no_fractions(own_registry):
    mimic.register("correspondence", "first", lambda expert, learner: MATRIX * [1, 0])
    fractions = MetricConfig(correspondence="first").link_fractions(EXPERT, LEARNER)
    np.testing.assert_allclose(fractions.sum(axis=0), [1.0, 0.0])


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (MATRIX.T, r"'bad': expected shape \[3, 2\], a row for each expert link \(link1, link2, link3\).*got \[2, 3\]"),
        (MATRIX * np.nan, "expected finite numbers"),
        (MATRIX - 1, "expected numbers from 0 to 1e.06, got -1 to 1"),
        (MATRIX * 0, "got zeros alone"),
    ],
)
def test_a_bad_matrix_is_one_line(own_registry, matrix, message):
    mimic.register("correspondence", "bad", lambda expert, learner: matrix)
    with pytest.raises(ValueError, match=message) as error:
        MetricConfig(correspondence="bad").build(EXPERT, LEARNER)
    assert "\n" not in str(error.value)


def test_a_registered_link_distance_replaces_the_weighted_parts(own_registry):
    def squared(expert_link, learner_link):
        return ((expert_link.position - learner_link.position) ** 2).sum()

    mimic.register("link_distance", "squared", squared)
    metric = MetricConfig(link_distance="squared").build(EXPERT, LEARNER)
    assert metric.weights == LinkDistance(squared) and not metric.is_static
    expert, learner = states()
    difference = np.asarray(expert.position)[:, None] - np.asarray(learner.position)
    np.testing.assert_allclose(metric.link_distances(expert, learner), (difference**2).sum(axis=-1), rtol=1e-5)
    # all that takes weights takes it: the pose that is nearest by positions alone
    solution = mimic.imitate_pose(LEARNER, LEARNER, np.array([0.5, -0.7]), np.eye(2), metric.weights)
    assert solution.distance < 1e-6  # the same arm
