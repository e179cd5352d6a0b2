import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.chain import Chain, Joint, Link, lock
from mimic.arms.embodiment import from_chain, load_mjcf, panda, planar_arm
from mimic.metric.correspondence import (
    arc_length_correspondence,
    hard_correspondence,
    overlap_correspondence,
    soft_correspondence,
)
from mimic.metric.distance import DistanceWeights, embodiment_distance
from mimic.metric.kinematics import link_states
from tests.helpers import random_arms


def random_distances(seed=0, shape=(5, 3)):
    return jnp.asarray(np.random.default_rng(seed).uniform(0, 3, shape))


# --- by distance ------------------------------------------------------------------------------------------------------


def test_hard_marks_the_nearest_of_each_row_and_column():
    distances = jnp.asarray([[3.0, 1.0, 2.0], [0.5, 4.0, 0.6]])
    # rows: link 1 is nearest to 2, link 2 to 1; columns: 2, 1 and 2 are nearest
    assert hard_correspondence(distances).tolist() == [[0, 2, 0], [2, 0, 1]]


def test_hard_gives_a_tie_to_the_first():
    assert hard_correspondence(jnp.ones((2, 3))).tolist() == [[2, 1, 1], [1, 0, 0]]


def test_hard_is_constant_under_differentiation():
    weighted = lambda distances: jnp.sum(hard_correspondence(distances) * distances)  # noqa: E731
    distances = random_distances()
    assert jax.grad(weighted)(distances).tolist() == hard_correspondence(distances).tolist()


def test_soft_is_a_softmax_over_rows_plus_one_over_columns(x64):
    distances = np.array([[1.0, 2.0], [0.0, 4.0]])
    a, b, c, d = np.exp(-0.5 * distances).ravel()
    expected = np.array([[a / (a + b) + a / (a + c), b / (a + b) + b / (b + d)],
                         [c / (c + d) + c / (a + c), d / (c + d) + d / (b + d)]])  # fmt: skip
    actual = soft_correspondence(jnp.asarray(distances), xi=-0.5)
    np.testing.assert_allclose(actual, expected, atol=1e-15)  # a few roundings of numbers below 2


@pytest.mark.parametrize("seed", range(5))
def test_hard_is_the_limit_of_soft(x64, seed):
    distances = random_distances(seed)
    hard = hard_correspondence(distances)
    errors = [
        float(abs(soft_correspondence(distances, xi=xi) - hard).max()) for xi in (-1.0, -10.0, -100.0, -1e4, -1e9)
    ]
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > 0.1
    assert errors[-1] == 0  # entries differ by more than 1e-4, and exp(-1e5) is 0


def test_dtypes_are_kept(x64):
    distances = random_distances().astype(jnp.float32)
    assert hard_correspondence(distances).dtype == jnp.float32
    assert soft_correspondence(distances, xi=np.float64(-3)).dtype == jnp.float32
    assert soft_correspondence(distances.astype(jnp.float64), xi=-3).dtype == jnp.float64


@pytest.mark.parametrize(
    "xi",
    [0, 1.0, np.nan, -np.inf, [-1.0, -2.0]],
    ids=lambda xi: f"{type(xi).__name__} {xi}",
)
def test_soft_rejects_a_sharpness_that_is_not_negative(unchecked, xi):
    with pytest.raises(ValueError, match="^xi: expected a finite number below 0, for a soft minimum, got .*$"):
        soft_correspondence(random_distances(), xi=xi)


def test_a_traced_sharpness_can_be_learned(x64):
    distances = random_distances()
    slope = jax.jit(jax.grad(lambda xi: jnp.mean(soft_correspondence(distances, xi=xi) * distances)))(-2.0)
    assert slope > 0  # a duller minimum makes the mean larger


# --- by place ---------------------------------------------------------------------------------------------------------

ARMS = {
    "panda": panda(),
    "panda4dof": panda(locked=(3, 6, 7)),
    "panda3dof": panda(locked=(2, 3, 6, 7)),
    "planar7": planar_arm([0.3, 0.1, 0.2, 0.2, 0.3, 0.1, 0.1]),
    "planar4": planar_arm([0.4, 0.4, 0.4, 0.3]),
    "random": load_mjcf(random_arms.random_arm(8)),
}


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_overlap_of_an_arm_with_itself_is_twice_the_identity(dtype, arm):
    assert overlap_correspondence(arm, arm).tolist() == (2 * np.eye(arm.num_links)).tolist()


def test_overlap_by_hand(x64):
    # on [0, 1]: the expert's links meet at 1/2, the learner's at 1/4
    actual = overlap_correspondence(planar_arm([2.0, 2.0]), planar_arm([0.5, 1.5]))
    expected = [[0.25 / 0.5 + 0.25 / 0.25, 0.25 / 0.5 + 0.25 / 0.75], [0, 0.5 / 0.5 + 0.5 / 0.75]]
    np.testing.assert_allclose(actual, expected, atol=1e-15)  # a few roundings of numbers below 2
    np.testing.assert_allclose(overlap_correspondence(planar_arm([1.0, 3.0]), planar_arm([5.0])), [[1.25], [1.75]])


@pytest.mark.parametrize("expert", ARMS)
@pytest.mark.parametrize("learner", ARMS)
def test_overlap_distributes_every_link(x64, expert, learner):
    """With o = W / (1/l + 1/l_hat): rows of o sum to the expert's lengths, columns to the learner's."""
    arms = ARMS[expert], ARMS[learner]
    length, length_hat = (arm.link_lengths / arm.link_lengths.sum() for arm in arms)
    correspondence = np.asarray(overlap_correspondence(*arms))
    shared = correspondence / (1 / length[:, None] + 1 / length_hat[None, :])
    np.testing.assert_allclose(shared.sum(axis=1), length, atol=1e-14)  # a rounding a link
    np.testing.assert_allclose(shared.sum(axis=0), length_hat, atol=1e-14)
    assert np.all(correspondence >= 0) and np.count_nonzero(correspondence) <= sum(correspondence.shape) - 1
    np.testing.assert_allclose(overlap_correspondence(*arms[::-1]), correspondence.T, atol=1e-14)


def test_links_that_only_touch_do_not_correspond():
    thirds, sixths = planar_arm([0.1] * 3), planar_arm([0.7 / 6] * 6)  # meet at 1/3 and 2/3, but for rounding
    assert np.count_nonzero(overlap_correspondence(thirds, sixths)) == 6


def test_merged_links_overlap_by_their_path():
    """A chord across a right angle, 2 along the path and sqrt(2) straight, next to a link of 1."""
    bent = merged_by_a_right_angle()
    assert bent.link_lengths == pytest.approx([np.sqrt(2), 1.0])
    twin = planar_arm([2.0, 1.0])
    np.testing.assert_allclose(overlap_correspondence(bent, twin), 2 * np.eye(2), atol=1e-9)
    assert np.count_nonzero(overlap_correspondence(bent, planar_arm([np.sqrt(2), 1.0]))) == 3
    traced = jax.jit(overlap_correspondence)(bent, twin)
    np.testing.assert_allclose(traced, 2 * np.eye(2), atol=1e-6)  # float32


def merged_by_a_right_angle():
    axis, points = np.array([0.0, 0.0, 1.0]), np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [2, 1, 0]])
    joints = tuple(Joint(f"joint{i + 1}", axis, points[i]) for i in range(3))
    links = tuple(Link(f"link{i + 1}", points[i], points[i + 1], i) for i in range(3))
    return from_chain(lock(Chain(joints, links), {"joint2": 0.0}, "merged"), name="bent")


# --- by common arc length ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ARMS)
def test_arc_length_of_an_arm_with_itself_counts_links_by_their_length(name):
    arm = ARMS[name]
    fraction = np.asarray(arm.link_lengths) / arm.link_lengths.sum()
    expected = arm.num_links**2 * np.diag(fraction)
    np.testing.assert_allclose(arc_length_correspondence(arm, arm), expected, rtol=1e-5)  # float32
    assert np.asarray(arc_length_correspondence(arm, arm)).mean() == pytest.approx(1, rel=1e-6)


def test_arc_length_ignores_that_a_straight_link_is_cut_in_two():
    whole, cut, other = planar_arm([1.0, 2.0]), planar_arm([1.0, 0.5, 1.5]), planar_arm([1.5, 1.0, 0.5])
    angles = np.array([0.3, -0.8, 0.5], np.float32)
    states = link_states(other, angles), link_states(whole, angles[:2]), link_states(cut, np.array([0.3, -0.8, 0.0]))
    rotation = DistanceWeights(translation=0.0, rotation=1.0)
    by_whole = embodiment_distance(*states[:2], arc_length_correspondence(other, whole), rotation)
    by_cut = embodiment_distance(states[0], states[2], arc_length_correspondence(other, cut), rotation)
    np.testing.assert_allclose(by_whole, by_cut, rtol=1e-5)  # float32
    overlaps = (overlap_correspondence(other, arm) for arm in (whole, cut))
    by_overlap = [embodiment_distance(states[0], s, w, rotation) for s, w in zip(states[1:], overlaps, strict=True)]
    assert abs(by_overlap[0] - by_overlap[1]) > 0.01  # what the paper's does


def test_arc_length_is_the_integral_of_the_pair_distance():
    """Two straight arms at an angle, one of them in links of any length: their mean angle is that angle."""
    line, bent = planar_arm([1.0]), planar_arm([0.1, 0.6, 0.3])
    angles = np.array([0.2, 0.5, -1.1], np.float32)
    states = link_states(line, np.zeros(1)), link_states(bent, angles)
    distance = embodiment_distance(
        *states, arc_length_correspondence(line, bent), DistanceWeights(0.0, 1.0), rotation="angle"
    )
    np.testing.assert_allclose(distance, np.abs(np.cumsum(angles)) @ [0.1, 0.6, 0.3], rtol=1e-5)  # float32
