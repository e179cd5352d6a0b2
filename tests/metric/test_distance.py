import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.embodiment import planar_arm
from mimic.metric.correspondence import hard_correspondence, overlap_correspondence
from mimic.metric.distance import (
    PAPER_WEIGHTS,
    DistanceWeights,
    Metric,
    RotationMeasure,
    adaptive_weights,
    embodiment_distance,
    link_distances,
    rotation_distance,
)
from mimic.metric.hand import HandWeights
from mimic.metric.kinematics import candidate_points, link_states
from tests.helpers.metric_cases import (
    ALL_WEIGHTS,
    CORRESPONDENCES,
    EXPERT,
    LEARNER,
    MEASURES,
    REDUCTIONS,
    WEIGHTS,
    states,
)

# --- values -----------------------------------------------------------------------------------------------------------


def worked_example():
    """Two arms with two links of 1 m, so L = 2. Positions and velocities by hand, divided by L.

    Expert at (0, pi/2), with both joints at 1 rad/s: link 1 points along x and rotates at 1 rad/s, link 2 along y at 2.
    Middles (1/2, 0) and (1, 1/2), velocities (0, 1/2) and (0, 1) + 2 (-1/2, 0) = (-1, 1).
    Learner stretched along x and at rest: middles (1/2, 0) and (3/2, 0).
    """
    arm = planar_arm([1.0, 1.0])
    expert = link_states(arm, jnp.asarray([0.0, np.pi / 2]), jnp.asarray([1.0, 1.0]))
    learner = link_states(arm, jnp.zeros(2), jnp.zeros(2))
    r = 2**0.5
    d_tr = np.array([[0, 1 / 2], [r / 4, r / 4]])  # (1/2, 1/2) / L and (-1/2, 1/2) / L for link 2
    d_rot = np.array([[0, 0], [np.pi / 2, np.pi / 2]])  # a right angle: pi/2 by both measures
    d_v = np.array([[1 / 4, 1 / 4], [r / 2, r / 2]])  # |(0, 1/2)| / L and |(-1, 1)| / L
    d_w = np.array([[1, 1], [2, 2]])
    return expert, learner, d_tr, d_rot, d_v, d_w


@pytest.mark.parametrize("rotation", MEASURES)
def test_link_distances_by_hand(x64, rotation: RotationMeasure):
    expert, learner, d_tr, d_rot, d_v, d_w = worked_example()
    per_pair = np.array([[1.0, 2.0], [3.0, 4.0]])
    for weights, expected in (
        (ALL_WEIGHTS, 2 * d_tr + d_rot + 3 * d_v + 0.5 * d_w),
        (PAPER_WEIGHTS, d_rot + 0.001 * d_v + 0.01 * d_w),
        (adaptive_weights, d_tr * d_tr + 2 / np.pi * (2 - d_tr) * d_rot),
        (DistanceWeights(translation=per_pair, rotation=0), per_pair * d_tr),
    ):
        actual = link_distances(expert, learner, weights, rotation=rotation)
        np.testing.assert_allclose(actual, expected, atol=1e-15, rtol=1e-14)  # a few roundings


def test_embodiment_distance_by_hand(x64):
    expert, learner, *_ = worked_example()
    # D' = 2 d_tr + d_rot + 3 d_v + d_w / 2 = [[1.25, 2.25], [5.3992, 5.3992]]
    link_2 = 2 * 2**0.5 / 4 + np.pi / 2 + 3 * 2**0.5 / 2 + 1
    assert round(link_2, 4) == 5.3992
    distance = functools.partial(embodiment_distance, expert, learner, weights=ALL_WEIGHTS)
    arm = planar_arm([1.0, 1.0])
    overlap = overlap_correspondence(arm, arm)  # 2 I
    assert distance(overlap) == pytest.approx((2 * 1.25 + 2 * link_2) / 4, rel=1e-14)  # a few roundings
    assert distance(overlap, reduction="frobenius") == pytest.approx(np.hypot(2.5, 2 * link_2), rel=1e-14)
    # rows: link 1 to 1, link 2 to 1 (first of a tie); columns: 1 to link 1, 2 to link 1
    nudged = dataclasses.replace(learner, position=learner.position.at[1, 1].add(-1e-9))  # breaks the tie for link 1
    hard = embodiment_distance(expert, nudged, hard_correspondence, ALL_WEIGHTS)
    assert hard == pytest.approx((2 * 1.25 + 2.25 + link_2) / 4, rel=1e-8)  # as far as the tie was broken
    assert distance(np.diag([1, 0])) == pytest.approx(1.25 / 4, rel=1e-14)


def test_rotation_measures():
    x, y = jnp.asarray([1.0, 0, 0]), jnp.asarray([0.0, 1, 0])
    for angle in np.linspace(0, np.pi, 9):
        turned = np.cos(angle) * x + np.sin(angle) * y
        assert rotation_distance(x, turned, "angle") == pytest.approx(angle, abs=1e-6)  # float32
        expected = np.pi / 2 * (1 - np.cos(angle))
        assert rotation_distance(x, turned) == pytest.approx(expected, abs=1e-6)  # float32
    assert rotation_distance(x, -x, "angle") == pytest.approx(np.pi, abs=1e-6)


@pytest.mark.parametrize("rotation", MEASURES)
@pytest.mark.parametrize("weights", [ALL_WEIGHTS, PAPER_WEIGHTS, adaptive_weights])
def test_zero_exactly_at_a_match_and_only_there(weights, rotation):
    arm = planar_arm([0.5, 0.2, 0.3])
    here, elsewhere = states(arm), states(arm, seed=1)
    itself = link_distances(here, here, weights, rotation=rotation)
    if rotation == "cosine":
        assert not np.diag(itself).any()
    else:
        np.testing.assert_allclose(np.diag(itself), 0, atol=1e-6)  # |e x e| rounds to 1e-7 in float32
    for reduction in REDUCTIONS:
        overlap = overlap_correspondence(arm, arm)
        distance = functools.partial(embodiment_distance, here, weights=weights, rotation=rotation, reduction=reduction)
        assert distance(here, overlap) == pytest.approx(0, abs=0 if rotation == "cosine" else 1e-5)  # as above
        assert distance(elsewhere, overlap) > 0.01


def test_candidate_points_are_compared_by_place_and_velocity():
    a, b = states(EXPERT), states(LEARNER, 1)
    weights = dataclasses.replace(ALL_WEIGHTS, rotation=0.0, angular_velocity=0.0)
    points = candidate_points(a), candidate_points(b)
    np.testing.assert_array_equal(link_distances(*points, weights), link_distances(a, b, weights))
    np.testing.assert_array_equal(link_distances(points[0], b, weights), link_distances(a, b, weights))
    alone = embodiment_distance(points[0], points[0], 2 * np.eye(3), weights)
    assert alone == 0
    square = link_distances(*points, DistanceWeights(translation=1.0, rotation=0.0)) ** 2
    np.testing.assert_allclose(link_distances(*points, adaptive_weights), square, rtol=1e-6)  # float32
    traced = jax.jit(link_distances)(*points, weights)
    np.testing.assert_allclose(traced, link_distances(a, b, weights), rtol=1e-6)  # float32


# --- batches and dtypes -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("correspondence", ["overlap", "hard"])
def test_a_batch_is_a_vmap_is_a_loop(correspondence):
    options = {"correspondence": CORRESPONDENCES[correspondence], "weights": adaptive_weights}
    distance = jax.jit(functools.partial(embodiment_distance, **options))
    pairs = [(states(EXPERT, seed), states(LEARNER, seed + 9)) for seed in range(4)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *pairs)
    one_by_one = [distance(*pair) for pair in pairs]
    np.testing.assert_allclose(jax.vmap(distance)(*stacked), one_by_one, rtol=1e-6)  # float32, another order
    np.testing.assert_allclose(distance(*stacked), one_by_one, rtol=1e-6)
    per_expert = distance(pairs[0][0], stacked[1])
    np.testing.assert_allclose(per_expert, [distance(pairs[0][0], pair[1]) for pair in pairs], rtol=1e-6)


@pytest.mark.parametrize(
    ("correspondence", "weights"), [("overlap", "constant"), ("hard", "matrix"), ("soft", "adaptive")]
)
def test_float32_stays_float32_under_x64(x64, correspondence, weights):
    args = {"correspondence": CORRESPONDENCES[correspondence], "weights": WEIGHTS[weights]}
    for dtype, reduction in ((np.float32, "mean"), (np.float32, "frobenius")):
        function = functools.partial(embodiment_distance, reduction=reduction, **args)
        pair = jax.tree.map(
            lambda x, dtype=dtype: jax.ShapeDtypeStruct(x.shape, dtype), (states(EXPERT), states(LEARNER))
        )
        assert jax.eval_shape(function, *pair).dtype == dtype
    double = dataclasses.replace(ALL_WEIGHTS, rotation=np.float64(1.0))
    assert link_distances(states(EXPERT), states(LEARNER), double).dtype == np.float32


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    "matrix",
    [np.ones((2, 3)), np.ones((1, 3, 2)), 1.0, lambda distances: distances.T],
    ids=lambda matrix: str(np.shape(matrix)),
)
def test_a_correspondence_of_another_shape_is_rejected(matrix):
    expected = r"^correspondence: expected shape \(3, 2\) \(expert links, learner links\), got \(.*\)$"
    with pytest.raises(ValueError, match=expected):
        embodiment_distance(states(EXPERT), states(LEARNER), matrix, PAPER_WEIGHTS)


@pytest.mark.usefixtures("unchecked")
def test_unknown_measures_and_reductions_are_rejected():
    pair = states(EXPERT), states(LEARNER)
    options = {"rotation": ("cosine, angle", "euler"), "reduction": ("mean, frobenius", "sum")}
    for option, (valid, bad) in options.items():
        with pytest.raises(ValueError, match=f"^{option}: expected one of {valid}, got '{bad}'$"):
            wrong: dict = {option: bad}
            embodiment_distance(*pair, hard_correspondence, PAPER_WEIGHTS, **wrong)
    for call in (
        lambda: link_distances(*pair, adaptive_weights, rotation="Angle"),  # pyright: ignore[reportArgumentType]
        lambda: rotation_distance(jnp.ones(3), jnp.ones(3), "Angle"),  # pyright: ignore[reportArgumentType]
    ):
        with pytest.raises(
            ValueError, match=r"^rotation: expected one of cosine, angle, got 'Angle'; did you mean angle\?$"
        ):
            call()


@pytest.mark.parametrize(
    ("part", "field"), [("rotation", "direction"), ("angular_velocity", "angular_velocity")], ids=lambda x: x
)
def test_candidate_points_reject_weights_on_what_they_lack(part, field):
    weights = dataclasses.replace(DistanceWeights(translation=1.0, rotation=0.0), **{part: 0.5})
    message = f"^weights: candidate points have no {field}, so {part} must weigh 0, got 0.5$"
    a, b = states(EXPERT), states(LEARNER)
    for pair in ((candidate_points(a), b), (a, candidate_points(b))):
        with pytest.raises(ValueError, match=message):
            link_distances(*pair, weights)
    for_one_pair = dataclasses.replace(weights, **{part: np.eye(3, 2)})
    with pytest.raises(ValueError, match=message.split(", got")[0]):
        link_distances(candidate_points(a), b, for_one_pair)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (DistanceWeights(translation=-1.0), "weights.translation: expected a number from 0 to 1e.06, got -1.0"),
        (DistanceWeights(rotation=np.array([[1.0], [np.nan], [0.0]])), "weights.rotation: expected a number from 0"),
        (DistanceWeights(linear_velocity=np.inf), "weights.linear_velocity: .* got inf"),
        ((0.0, 1.0), "weights: expected DistanceWeights, a function or a LinkDistance, got"),
        (HandWeights(position=-1.0), "hand_weights.position: expected a number from 0 to 1e.06, got -1.0"),
    ],
)
def test_weights_out_of_range_are_rejected(weights, message):
    options: Any = {
        "weights": PAPER_WEIGHTS,
        ("hand_weights" if isinstance(weights, HandWeights) else "weights"): weights,
    }
    with pytest.raises(ValueError, match=message):
        Metric(np.ones((3, 2)), **options)


@pytest.mark.parametrize(
    ("matrix", "message"), [(-np.eye(2), "numbers from 0 to"), (np.full((3, 2), np.nan), "finite"), (None, "finite")]
)
def test_a_correspondence_of_other_than_finite_numbers_is_rejected(matrix, message):
    with pytest.raises(ValueError, match=f"^correspondence: expected {message}"):
        Metric(matrix, PAPER_WEIGHTS)


def test_link_distances_have_the_same_rule():
    with pytest.raises(ValueError, match="weights.rotation: expected a number from 0"):
        link_distances(states(EXPERT), states(LEARNER), DistanceWeights(rotation=-1.0))


def test_weights_of_another_shape_are_rejected():
    expected = (
        r"^weights: expected rotation to broadcast to \(3, 2\) \(expert links, learner links\), got shape \(3, 3\)$"
    )
    with pytest.raises(ValueError, match=expected):
        link_distances(states(EXPERT), states(LEARNER), DistanceWeights(rotation=np.ones((3, 3))))
