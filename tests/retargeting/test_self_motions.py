"""Tests of mimic/retargeting/self_motions.py."""

import numpy as np
import pytest

from mimic.arms.embodiment import panda
from mimic.arms.link_match import hand_poses
from mimic.arms.pose_limits import continuous_joints, motion_limits
from mimic.retargeting.self_motions import _Arm, _next, past_failing_times

TIMES, FAILING = 60, slice(30, 45)
HAND = np.zeros(1, int)
JUMP = np.full(7, 0.05)  # rad from one time to the next


@pytest.fixture(scope="module")
def motion():
    """A motion of the Panda [time, joints] within `JUMP`, without a posture near a limit."""
    start = np.array([0.1, -0.4, 0.2, -1.8, 0.1, 1.6, 0.5])
    time = np.linspace(0, 1, TIMES)[:, None]
    return start + np.array([0.9, 0.5, -0.8, 0.4, 0.7, 0.5, -0.9]) * np.sin(3 * time)


def errors(path, targets):
    """Largest difference of the entries of the hands' poses at each time."""
    return np.abs(hand_poses(panda(), path) - targets).max(axis=(1, 2, 3))


def test_a_redundant_arm_gets_past_times_without_an_exact_hand(motion):
    targets, path, exact = hand_poses(panda(), motion), motion.copy(), np.ones(TIMES, bool)
    path[FAILING], exact[FAILING] = motion[FAILING.start - 1], False
    assert errors(path, targets)[~exact].min() > 1e-3
    found = past_failing_times(panda(), HAND, targets, path, exact, JUMP)
    assert errors(found, targets).max() < 1e-4  # entries of exact hands: 0.1 mm, and 0.01 deg is 1.7e-4 rad
    assert (np.abs(np.diff(found, axis=0)) <= JUMP).all()
    np.testing.assert_array_equal(found[-1], path[-1])  # back on the path


@pytest.mark.parametrize("possible", [None, np.arange(TIMES) != FAILING.start])
def test_a_path_that_no_way_leads_past_stays(motion, possible):
    targets, path, exact = hand_poses(panda(), motion), motion.copy(), np.ones(TIMES, bool)
    exact[FAILING] = False
    if possible is None:
        targets[FAILING.start, :, 2, 3] += 2.0  # m, out of reach
    np.testing.assert_array_equal(past_failing_times(panda(), HAND, targets, path, exact, JUMP, possible), path)


def test_a_way_may_begin_with_other_postures_at_the_first_time(motion):
    targets, path, exact = hand_poses(panda(), motion), motion.copy(), np.ones(TIMES, bool)
    path[:5], exact[:5] = 0.0, False
    np.testing.assert_array_equal(past_failing_times(panda(), HAND, targets, path, exact, JUMP)[:5], path[:5])
    found = past_failing_times(panda(), HAND, targets, path, exact, JUMP, starts=motion[:1])
    assert errors(found, targets).max() < 1e-4


def test_a_way_does_not_begin_with_a_posture_that_is_not_exact(motion):
    targets, path, exact = hand_poses(panda(), motion), motion.copy(), np.arange(TIMES) > 0
    path[0] += JUMP / 4
    found = past_failing_times(panda(), HAND, targets, path, exact, JUMP, starts=motion[:1])
    assert errors(found, targets).max() < 1e-4
    alone = past_failing_times(panda(), HAND, targets[:1], path[:1], exact[:1], JUMP, starts=motion[:1])
    assert errors(alone, targets[:1]).max() < 1e-4


def test_joints_without_a_limit_of_speed_are_searched(motion):
    targets, path, exact = hand_poses(panda(), motion), motion.copy(), np.ones(TIMES, bool)
    path[FAILING], exact[FAILING] = motion[FAILING.start - 1], False
    found = past_failing_times(panda(), HAND, targets, path, exact, np.full(7, np.inf))
    assert errors(found, targets).max() < 1e-4


def test_postures_of_which_the_least_change_is_too_fast_go_along_their_curve():
    """The rest, below 10 %, are those whose curve bends within one step."""
    arm = _Arm(panda(), HAND, JUMP, *motion_limits(panda()), continuous_joints(panda()))
    random = np.random.default_rng(0)
    postures = random.uniform(-2, 2, (200, 7))
    postures[:, 3] = random.uniform(-2.5, -0.5, 200)
    later = postures + 0.9 * JUMP * random.choice([-1, 1], postures.shape)  # reachable in time, and so are the hands
    reached = [_next(arm, hand, qpos[None])[0] for hand, qpos in zip(hand_poses(panda(), later), postures, strict=True)]
    assert np.mean([len(qpos) > 0 for qpos in reached]) > 0.9
    for before, after in zip(postures, reached, strict=True):
        assert (np.abs(after - before) <= JUMP).all()
