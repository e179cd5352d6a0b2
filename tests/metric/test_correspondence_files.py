"""Correspondence matrices from files and of registered functions."""

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


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_the_matrix_of_a_file_is_the_correspondence(tmp_path, suffix):
    path = str(tmp_path / f"matrix{suffix}")
    if suffix == ".csv":
        np.savetxt(path, MATRIX, delimiter=", ")
    else:
        np.savez(path, correspondence=MATRIX)
    config = MetricConfig(correspondence=path, hand_rotation=0.0)
    metric = config.build(EXPERT, LEARNER)
    assert metric.is_static
    np.testing.assert_array_equal(metric.correspondence, MATRIX)
    np.testing.assert_allclose(
        metric(*states()), mimic.embodiment_distance(*states(), MATRIX, config.make_weights()), rtol=1e-6
    )
    np.testing.assert_allclose(config.link_fractions(EXPERT, LEARNER).sum(axis=0), 1.0)


def test_a_link_without_a_partner_has_no_fractions(tmp_path):
    np.savetxt(tmp_path / "matrix.csv", MATRIX * [1, 0], delimiter=",")
    fractions = MetricConfig(correspondence=str(tmp_path / "matrix.csv")).link_fractions(EXPERT, LEARNER)
    np.testing.assert_allclose(fractions.sum(axis=0), [1.0, 0.0])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1,0\n0,1", r"expected shape \[3, 2\], a row for each expert link \(link1, link2, link3\).*got \[2, 2\]"),
        ("1,0\n0\n0,1", "expected rows of equal length"),
        ("", "expected rows of equal length"),
        ("1,0\n0,1\n1,x", "expected a number, got 'x'"),
        ("1,0\n0,1\n1,nan", "expected finite numbers"),
        ("1,0\n0,1\n1,-1", "expected numbers from 0 to 1e.06, not all of them 0, got -1 to 1"),
        ("0,0\n0,0\n0,0", "not all of them 0"),
        (b"\xff\xfe", "expected text"),
        ("1," * 2**20, "expected at most 1,048,576 bytes"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path, content, message):
    path = tmp_path / "matrix.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=message) as error:
        MetricConfig(correspondence=str(path)).build(EXPERT, LEARNER)
    assert "\n" not in str(error.value)


def test_a_bad_npz_or_no_file_is_one_line(tmp_path):
    np.savez(tmp_path / "matrix.npz", other=MATRIX)
    with pytest.raises(ValueError, match="expected an array 'correspondence'"):
        MetricConfig(correspondence=str(tmp_path / "matrix.npz")).build(EXPERT, LEARNER)
    with pytest.raises(ValueError, match="no file at 'none.csv'"):
        MetricConfig(correspondence="none.csv").build(EXPERT, LEARNER)


def test_a_registered_correspondence_is_a_matrix_or_a_function(own_registry):
    mimic.register("correspondence", "fixed", lambda expert, learner: MATRIX)
    mimic.register("correspondence", "nearest", lambda expert, learner: mimic.hard_correspondence)
    mimic.register("correspondence", "bad", lambda expert, learner: MATRIX.T)
    np.testing.assert_array_equal(MetricConfig(correspondence="fixed").build(EXPERT, LEARNER).correspondence, MATRIX)
    nearest = MetricConfig(correspondence="nearest").build(EXPERT, LEARNER)
    assert nearest(*states()) == MetricConfig(correspondence="hard").build(EXPERT, LEARNER)(*states())
    with pytest.raises(ValueError, match=r"'bad': expected shape \[3, 2\]"):
        MetricConfig(correspondence="bad").build(EXPERT, LEARNER)


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
