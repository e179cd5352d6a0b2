"""Exact hands: against closed forms, dense searches and closed-form inverse kinematics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.embodiment import Embodiment, panda, planar_arm
from mimic.arms.link_match import hand_poses
from mimic.base import compat
from mimic.metric.config import MetricConfig
from mimic.metric.distance import embodiment_distance
from mimic.metric.kinematics import link_states
from mimic.retargeting import exact_candidates
from mimic.retargeting.base_placement import find_base, repeated
from mimic.retargeting.costs import NO_COSTS
from mimic.retargeting.exact_candidates import Candidates, candidates_of_motions
from mimic.retargeting.exact_chunks import in_chunks
from mimic.retargeting.exact_trajectory import best_path, within_ranges
from mimic.retargeting.hand_speeds import speeds_needed
from mimic.retargeting.hand_target import (
    POSITION_TOLERANCE,
    ROTATION_TOLERANCE,
    HandTarget,
    hand_cost_derivatives,
    hands,
    placement,
)
from mimic.retargeting.initial_guesses import random_poses
from mimic.retargeting.pose import imitate_pose
from mimic.retargeting.trajectory import imitate_trajectory

EXPERT = planar_arm([0.5, 0.4, 0.3])
BASE = np.array([0.1, -0.2, 0.0, 0.4])  # x, y, z, yaw


def planar_poses(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-2, 2, (count, 3)).astype(np.float32)


def planar_hands(qpos: np.ndarray, lengths: list[float]) -> np.ndarray:
    """x, y and direction [rad] of the hands of planar arms in their base frames."""
    angles = np.cumsum(np.asarray(qpos, float), axis=-1)
    points = [np.sum(lengths * f(angles), axis=-1) for f in (np.cos, np.sin)]
    return np.stack([*points, angles[..., -1]], axis=-1)


def in_learner_base(hand: np.ndarray) -> np.ndarray:
    x, y = (hand[:, :2] - BASE[:2]).T
    cosine, sine = np.cos(BASE[3]), np.sin(BASE[3])
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, hand[:, 2] - BASE[3]], axis=-1)


def solve(learner: Embodiment, qpos: np.ndarray, expert: Embodiment = EXPERT, **options):
    metric = MetricConfig().build(expert, learner)
    return imitate_pose(expert, learner, qpos, **metric.arguments, hand="exact", **options)


def distance_of(learner: Embodiment, pose: np.ndarray, qpos: np.ndarray) -> np.ndarray:
    """The metric in the axes of the learner's base: planar directions turn by the yaw, which joint 1 does too."""
    metric = MetricConfig().build(EXPERT, learner)
    states = link_states(EXPERT, jnp.asarray(pose - np.array([BASE[3], 0, 0], np.float32)))
    own = link_states(learner, jnp.asarray(qpos))
    return np.asarray(embodiment_distance(states, own, metric.correspondence, metric.weights))


def test_a_planar_arm_takes_the_better_of_its_two_closed_form_postures():
    """With three joints the hand leaves two elbows; where the wrist is out of reach nothing is claimed."""
    lengths, qpos = [0.6, 0.45, 0.2], planar_poses(40)
    learner = planar_arm(lengths)
    solution = solve(learner, qpos, base=BASE)
    hand = in_learner_base(planar_hands(qpos, [0.5, 0.4, 0.3]))
    wrist = hand[:, :2] - lengths[2] * np.stack([np.cos(hand[:, 2]), np.sin(hand[:, 2])], axis=-1)
    cosine = (np.sum(wrist**2, axis=1) - lengths[0] ** 2 - lengths[1] ** 2) / (2 * lengths[0] * lengths[1])
    reachable = np.abs(cosine) < 1
    assert reachable.any() and not reachable.all()
    np.testing.assert_array_equal(solution.hand.exact, reachable)
    elbow = np.arccos(cosine[reachable])[:, None] * np.array([1, -1])
    inner = np.arctan2(lengths[1] * np.sin(elbow), lengths[0] + lengths[1] * np.cos(elbow))
    first = np.arctan2(wrist[:, 1], wrist[:, 0])[reachable, None] - inner
    postures = np.stack([first, elbow, hand[reachable, 2, None] - first - elbow], axis=-1).astype(np.float32)
    closed_form = distance_of(learner, qpos[reachable, None], postures).min(axis=1)
    np.testing.assert_allclose(np.asarray(solution.distance)[reachable], closed_form, atol=1e-5)  # float32
    errors = planar_hands(solution.qpos, lengths) - hand
    assert np.abs(errors[reachable, :2]).max() < 2e-6  # m; float32
    np.testing.assert_allclose(np.exp(1j * errors[reachable, 2]), 1, atol=5e-6)


@pytest.mark.slow
def test_a_redundant_planar_arm_finds_the_minimum_of_a_dense_search():
    lengths, qpos = [0.4, 0.35, 0.3, 0.2], planar_poses(12)
    learner = planar_arm(lengths)
    solution = solve(learner, qpos, base=BASE)
    hand = in_learner_base(planar_hands(qpos, [0.5, 0.4, 0.3]))
    for pose, (x, y, angle), exact, best in zip(qpos, hand, solution.hand.exact, solution.distance, strict=True):
        first = np.linspace(-np.pi, np.pi, 20_001)
        wrist = np.stack([x - 0.2 * np.cos(angle) - 0.4 * np.cos(first), y - 0.2 * np.sin(angle) - 0.4 * np.sin(first)])
        cosine = (np.sum(wrist**2, axis=0) - 0.35**2 - 0.3**2) / (2 * 0.35 * 0.3)
        valid = np.abs(cosine) <= 1
        assert exact == valid.any()
        values = []
        for sign in (1, -1):
            elbow = sign * np.arccos(np.clip(cosine, -1, 1))
            second = np.arctan2(wrist[1], wrist[0])
            second = second - np.arctan2(0.3 * np.sin(elbow), 0.35 + 0.3 * np.cos(elbow))
            postures = np.stack([first, second - first, elbow, angle - second - elbow], axis=-1)[valid]
            values.append(distance_of(learner, pose, postures.astype(np.float32)) if valid.any() else [np.inf])
        if exact:
            assert best <= np.min(np.concatenate(values)) + 1e-4


@pytest.mark.slow
def test_a_redundant_arm_takes_a_posture_as_near_as_a_wide_search_finds():
    arm = panda()
    lower, upper = (np.asarray(limit) for limit in arm.joint_range.T)
    qpos = np.random.default_rng(0).uniform(0.8 * lower + 0.2 * upper, 0.2 * lower + 0.8 * upper, (60, 7))
    few, many = (solve(arm, qpos.astype(np.float32), arm, base=[0.1, 0.05, 0.1, 0.3], starts=n) for n in (35, 150))
    exact = np.asarray(few.hand.exact)
    assert exact.sum() > 20
    nearer = np.minimum(many.distance, few.distance)[exact]
    assert np.mean(few.distance[exact]) < 1.005 * np.mean(nearer)


def test_two_joints_put_the_hand_in_place_and_report_its_angle():
    """Position before rotation: an arm of two links reaches each point of a ring; outside of it it is stretched."""
    learner, qpos = planar_arm([0.5, 0.4]), planar_poses(30)
    solution = solve(learner, qpos)
    hand, own = planar_hands(qpos, [0.5, 0.4, 0.3]), planar_hands(solution.qpos, [0.5, 0.4])
    radius = np.linalg.norm(hand[:, :2], axis=1)
    missing = np.maximum(np.maximum(radius - 0.9, 0.1 - radius), 0)
    np.testing.assert_allclose(solution.hand.position, missing, atol=2e-4)  # the rotation pulls at the ring's edge
    angle = np.abs(np.angle(np.exp(1j * (own[:, 2] - hand[:, 2]))))
    np.testing.assert_allclose(solution.hand.rotation, angle, atol=1e-3)
    assert not np.any(solution.hand.exact) and (missing > 0.01).any() and (missing == 0).any()


def test_derivatives_of_the_hand_are_those_of_differences():
    """In double precision, by NumPy."""
    arm = panda()
    target = HandTarget(*map(np.asarray, hands(arm, list(np.array([0.3, -0.2, 0.5, -1.0, 0.2, 0.7, 0.1])), [0])))

    def at(qpos: np.ndarray):
        return hand_cost_derivatives(arm, [0], target, [np.array(q) for q in qpos], 0.7)

    qpos, step = np.array([0.1, 0.4, -0.3, -1.5, 0.6, 1.2, -0.8]), 1e-5
    closed = at(qpos)
    for j, change in enumerate(step * np.eye(7)):
        above, below = at(qpos + change), at(qpos - change)
        assert abs(closed.gradient[j] - (above.value - below.value) / (2 * step)) < 1e-8
        for i in range(j + 1):
            difference = (above.gradient[i] - below.gradient[i]) / (2 * step)
            assert abs(closed.hessian[j][i] - difference) < 1e-8


@pytest.mark.parametrize(
    ("base", "message"),
    [
        ([0] * 3, "expected"),
        ([0, 0, np.nan, 0], "finite"),
        ([0, 0, 0, 90], "2 pi rad, got 90"),
        (np.diag([1.0, 1, -1, 1]), "rotation"),
    ],
)
def test_a_base_that_is_no_pose_is_an_error(base, message):
    with pytest.raises(ValueError, match=message):
        placement(base)


def test_a_base_without_exact_hands_is_an_error():
    metric = MetricConfig().build(EXPERT, EXPERT)
    with pytest.raises(ValueError, match="base"):
        imitate_pose(EXPERT, EXPERT, np.zeros(3), **metric.arguments, base=BASE)


def test_a_placement_by_yaw_is_that_by_a_matrix():
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]]
    matrix[:3, 3] = BASE[:3]
    for a, b in zip(placement(BASE), placement(matrix), strict=True):
        np.testing.assert_allclose(a, b)


@pytest.mark.parametrize("count", [1, 257, 700])
def test_no_path_is_better_than_the_best(count):
    """Against dynamic programming by NumPy, of random candidates of a continuous joint and one that is not."""
    rng, jump, continuous = np.random.default_rng(0), np.array([0.5, 0.2], np.float32), np.array([True, False])
    qpos, cost = rng.uniform(-3, 3, (count, 5, 2)).astype(np.float32), rng.uniform(0, 20, (count, 5)).astype(np.float32)
    apart = qpos[1:, None] - qpos[:-1, :, None]  # [time, from, to, joints]
    apart[..., 0] = (apart[..., 0] + np.pi) % (2 * np.pi) - np.pi
    late = np.maximum(np.ceil(np.abs(apart / jump).max(axis=-1)) - 1, 0)
    total = cost[0]
    for steps, own in zip(late, cost[1:], strict=True):
        total = own + (total[:, None] + 1.5 * steps).min(axis=0)
    path = best_path(Candidates(qpos, cost), jump, continuous, 1.5)
    differs = np.abs(path[:, None] - qpos)
    differs[..., 0] = np.abs((differs[..., 0] + np.pi) % (2 * np.pi) - np.pi)
    chosen, times = differs.max(axis=-1).argmin(axis=1), np.arange(count)
    assert differs.max(axis=-1)[times, chosen].max() < 1e-3
    reached = cost[times, chosen].sum() + 1.5 * late[times[:-1], chosen[:-1], chosen[1:]].sum()
    assert reached == pytest.approx(total.min(), abs=2)  # angles at a whole number of steps may round either way


@pytest.mark.slow
def test_candidates_of_many_motions_at_once_are_those_of_each(monkeypatch):
    """As on a GPU, where a chunk has the times of many motions, beside one motion after another."""
    metric, lengths = MetricConfig().build(EXPERT, EXPERT), (300, 40, 513)
    motions = [0.3 * np.sin(np.arange(n)[:, None] / 30 + np.arange(3)).astype(np.float32) for n in lengths]
    arms, jump = (EXPERT, EXPERT, metric, NO_COSTS, None), np.full(3, 0.1, np.float32)
    arguments = placement(None), jump, random_poses(EXPERT, None, 4, np.float32, 16)
    each = [candidates_of_motions(arms, [motion], *arguments)[0] for motion in motions]
    monkeypatch.setattr(compat, "is_cpu", lambda: False)
    for name in ("_branches", "_tracks"):  # without the cache, which has those of a CPU
        make = getattr(exact_candidates, name).__wrapped__
        monkeypatch.setattr(exact_candidates, name, lambda *arms, make=make: jax.jit(make(*arms)))
    monkeypatch.setattr(exact_candidates, "_candidates", exact_candidates._candidates.__wrapped__)
    together = candidates_of_motions(arms, motions, *arguments)
    for one, other, length in zip(each, together, lengths, strict=True):
        assert one.qpos.shape[0] == other.qpos.shape[0] == length
        exact = np.minimum(one.cost.min(axis=1), other.cost.min(axis=1)) < exact_candidates.INEXACT
        assert exact.all()
        np.testing.assert_allclose(one.cost.min(axis=1), other.cost.min(axis=1), atol=1e-3)  # of the best branch


def test_a_path_beyond_a_revolution_is_shifted_into_the_range():
    path = np.linspace(3.0, 9.0, 7)[:, None]
    ranges = np.array([[-2 * np.pi, 2 * np.pi]])
    shifted = within_ranges(path, ranges)
    assert np.all(np.abs(shifted) <= 2 * np.pi)
    np.testing.assert_allclose(np.diff(shifted, axis=0), np.diff(path, axis=0))


ARM = panda(limits="hardware")
OFFSET = np.array([0.15, -0.1, 0.05, 0.5])


def homogeneous(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def check_hands(solution, qpos: np.ndarray) -> None:
    """Exact hands are where the kinematics in double precision say, within the joint ranges."""
    base = placement(OFFSET)
    expected = np.linalg.inv(homogeneous(*base)) @ hand_poses(ARM, qpos)[..., 0, :, :]
    own, exact = hand_poses(ARM, np.asarray(solution.qpos))[..., 0, :, :], np.asarray(solution.hand.exact)
    apart = np.linalg.norm((own - expected)[..., :3, 3], axis=-1)
    turned = np.linalg.norm((own - expected)[..., :3, :3], axis=(-2, -1)) / np.sqrt(2)
    # A singular posture converges slowly.
    for error, tolerance in ((apart[exact], POSITION_TOLERANCE), (turned[exact], ROTATION_TOLERANCE)):
        assert error.max() < tolerance and np.quantile(error, 0.99) < tolerance / 10
    np.testing.assert_allclose(solution.hand.position, apart, atol=2e-6)  # m; float32
    lower, upper = ARM.joint_range.T
    assert np.all((solution.qpos >= lower - 1e-6) & (solution.qpos <= upper + 1e-6))


@pytest.mark.slow
def test_what_closed_form_inverse_kinematics_solves_is_solved():
    """Of 300 random poses, at least 99.9 %."""
    ssik = pytest.importorskip("ssik")
    qpos = np.random.default_rng(0).uniform(*ARM.joint_range.T, (300, 7)).astype(np.float32)
    solution = solve(ARM, qpos, ARM, base=OFFSET)
    check_hands(solution, qpos)
    points = np.concatenate([np.zeros((1, 3)), ARM.joint_anchor, ARM.hand_position])
    peer = ssik.Manipulator.from_axes(ARM.joint_axis, np.diff(points, axis=0), limits=ARM.joint_range)
    targets = np.linalg.inv(homogeneous(*placement(OFFSET))) @ hand_poses(ARM, qpos)[:, 0]
    targets[:, :3, :3] = targets[:, :3, :3] @ ARM.hand_rotation[0].T
    solved = np.array([bool(peer.solve(target)) for target in targets])
    assert 0.3 < solved.mean() < 0.95
    assert np.mean(np.asarray(solution.hand.exact)[solved]) >= 0.999


@pytest.mark.slow
def test_a_motion_is_exact_continuous_and_within_limits():
    time = np.linspace(0, 4, 300)
    swing = np.sin(time[:, None] * np.array([0.7, 0.9, 0.5, 0.8, 1.1, 0.6, 1.3]))
    qpos = (np.asarray(ARM.home) + 0.4 * swing).astype(np.float32)
    metric, jump = MetricConfig().build(ARM, ARM), ARM.velocity_limit * (time[1] - time[0])
    solution = imitate_trajectory(ARM, ARM, qpos, **metric.arguments, hand="exact", base=OFFSET, largest_jump=jump)
    check_hands(solution, qpos)
    assert np.all(solution.hand.exact)
    assert np.all(np.abs(np.diff(solution.qpos, axis=0)) <= jump * (1 + 1e-5))
    single = imitate_pose(ARM, ARM, qpos[::20], **metric.arguments, hand="exact", base=OFFSET)
    assert np.mean(solution.distance[::20]) <= np.mean(single.distance) + 0.02  # which need not be one path


@pytest.mark.slow
def test_a_motion_out_of_reach_stays_continuous_and_claims_nothing_there():
    time = np.linspace(0, 6, 300)
    qpos = np.zeros((300, 7), np.float32) + np.array([0, 0.3, 0, -2.6, 0, 2.1, 0.7])
    qpos[:, 3] = -2.6 + 2.0 * np.sin(np.pi * time / 6)  # stretches the arm, and bends it again
    qpos = np.concatenate([qpos, np.repeat(qpos[-1:], 25, axis=0)])  # bent arms are faster than stretched ones: waits
    metric, jump = MetricConfig().build(ARM, ARM), ARM.velocity_limit * (time[1] - time[0])
    base = [-0.2, 0, 0, 0]
    solution = imitate_trajectory(ARM, ARM, qpos, **metric.arguments, hand="exact", base=base, largest_jump=jump)
    exact = np.asarray(solution.hand.exact)
    assert exact[:5].all() and exact[-20:].all() and not exact[135:165].any()
    assert np.asarray(solution.hand.position)[135:165].min() > 0.01
    assert np.all(np.abs(np.diff(solution.qpos, axis=0)) <= jump * (1 + 1e-5))


@pytest.mark.slow
def test_a_base_is_found_from_which_a_small_arm_follows():
    """A Panda of 0.6 times the size does not reach from the expert's base."""
    lengths = ("joint_anchor", "link_position", "link_lengths", "segment_start", "segment_end", "hand_position")
    small = dataclasses.replace(ARM, **{name: 0.6 * getattr(ARM, name) for name in lengths})
    swing = np.sin(np.linspace(0, 2, 60)[:, None] * np.array([0.7, 0.9, 0.5, 0.8, 1.1, 0.6, 1.3]))
    motion, metric = (np.asarray(ARM.home) + 0.2 * swing).astype(np.float32), MetricConfig().build(ARM, small)
    base = find_base(ARM, small, [motion], **metric.arguments)
    exact = [
        np.mean(imitate_trajectory(ARM, small, motion, **metric.arguments, hand="exact", base=b).hand.exact)
        for b in (None, base)
    ]
    assert exact[0] < 0.5 and exact[1] == 1


def test_speeds_that_a_hand_needs_are_those_of_the_joints_of_a_planar_arm():
    """Of the same arm with a rotated base, whose three joints have no choice for a hand in the plane."""
    qpos, limit = planar_poses(20), np.array([1.0, 2.0, 0.5])
    qvel = np.random.default_rng(1).uniform(-1, 1, qpos.shape)
    base, postures = repeated(np.array([[0.0, 0.0, 0.0, 0.4]]), 20), qpos - np.array([0.4, 0, 0])
    needed = speeds_needed(EXPERT, EXPERT, qpos, qvel, postures, base, limit)
    np.testing.assert_allclose(needed, np.abs(qvel / limit).max(axis=1), rtol=1e-4)  # of angles in single precision
    shift = repeated(np.array([[0.3, -0.2, 0.1, 0.4]]), 20)  # of the base, which changes no velocity
    np.testing.assert_array_equal(needed, speeds_needed(EXPERT, EXPERT, qpos, qvel, postures, shift, limit))


@pytest.mark.parametrize("count", [1, 3, 4, 5, 8, 9])
def test_each_time_is_in_a_chunk(count):
    """Chunks of four times, which need the next one: the time after a whole number of chunks is one of its own."""
    rows = np.arange(count)
    chunks = list(in_chunks(rows, 5, overlap=1))
    assert all(len(chunk) == 5 for chunk in chunks)
    np.testing.assert_array_equal(np.concatenate([chunk[:4] for chunk in chunks])[:count], rows)
