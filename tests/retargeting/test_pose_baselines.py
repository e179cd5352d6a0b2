"""Baselines for poses reach their closed forms and stay within the limits of the learner."""

import dataclasses

import numpy as np
import pytest

from mimic.arms.embodiment import Embodiment, panda, planar_arm
from mimic.metric.similarity import centre_line_table, similarity
from mimic.retargeting.pose_baselines import BASELINES, copy_joints, hand_ik, hold_home

PANDA = panda()


def motion(arm: Embodiment, count: int, time: int = 1, spread: float = np.pi) -> np.ndarray:
    """Random poses, each held; or random walks from them."""
    rng = np.random.default_rng(0)
    first = rng.uniform(-spread, spread, (count, 1, arm.num_joints))
    steps = rng.normal(0, 0.05, (count, time, arm.num_joints))
    steps[:, 0] = 0
    return first + np.cumsum(steps, axis=1)


def test_copying_takes_shared_joints_by_name():
    learner = panda(locked=(3, 6))
    qpos = motion(PANDA, 3)
    np.testing.assert_array_equal(copy_joints(PANDA, learner, qpos), qpos[..., [0, 1, 3, 4, 6]])


def test_copying_stays_within_limits():
    learner = panda(limits="hardware")
    copied = copy_joints(PANDA, learner, motion(PANDA, 50))
    assert copied is not None
    assert np.all((copied >= learner.joint_range[:, 0]) & (copied <= learner.joint_range[:, 1]))


def test_copying_is_not_available_without_a_common_joint():
    other = planar_arm([0.5, 0.5])
    renamed = dataclasses.replace(other, joint_names=("a", "b"))
    assert copy_joints(PANDA, renamed, motion(PANDA, 2)) is None


@pytest.mark.parametrize("name", BASELINES)
def test_shapes_and_dtype(name):
    learner = panda(locked=(2, 4))
    qpos = motion(PANDA, 6, time=4).reshape(2, 3, 4, 7).astype(np.float32)
    poses = BASELINES[name](PANDA, learner, qpos)
    assert poses is not None
    assert poses.shape == (2, 3, 4, 5)
    assert poses.dtype == np.float32


@pytest.mark.parametrize("name", BASELINES)
def test_bad_poses_are_rejected(name):
    with pytest.raises(ValueError, match=r"expected shape \[\.\.\., time, 7\]"):
        BASELINES[name](PANDA, PANDA, np.zeros(7))
    with pytest.raises(ValueError, match="finite"):
        BASELINES[name](PANDA, PANDA, np.full((1, 7), np.nan))


def test_holding_is_the_home_pose():
    learner = panda(limits="hardware")
    held = hold_home(PANDA, learner, motion(PANDA, 2, 3))
    np.testing.assert_allclose(held, np.broadcast_to(learner.home, (2, 3, 7)))


def test_hand_ik_of_an_equal_arm_reaches_the_hand():
    qpos = motion(PANDA, 8, time=11)
    by_ik = hand_ik(PANDA, PANDA, qpos, every=1)
    assert by_ik is not None
    hands = [centre_line_table(PANDA, q) for q in (qpos, by_ik)]
    miss = similarity(*hands)
    # Steps end at 1e-4 rad, and four starts do not all find the pose: seven of eight motions must.
    reached = (miss["hand_position_error"] < 1e-3) & (miss["hand_angle_deg"] < 0.1)
    assert reached.all(axis=1).sum() >= 7


def test_hand_ik_keeps_to_the_joint_range():
    learner = panda(limits="hardware")
    poses = hand_ik(PANDA, learner, motion(PANDA, 4, time=11))
    slack = 1e-6  # rad: the solver's tolerance on constraints
    assert np.all((poses >= learner.joint_range[:, 0] - slack) & (poses <= learner.joint_range[:, 1] + slack))


def test_hand_ik_interpolates_between_solved_samples():
    qpos = motion(PANDA, 1, time=8, spread=1.0)
    by_ik = hand_ik(PANDA, PANDA, qpos, every=5)  # samples 0, 5 and 7 are solved
    assert by_ik is not None
    poses = by_ik[0]
    np.testing.assert_allclose(poses[6], (poses[5] + poses[7]) / 2, atol=1e-12)
    np.testing.assert_allclose(np.diff(poses[:6], axis=0), np.tile((poses[5] - poses[0]) / 5, (5, 1)), atol=1e-12)
    with pytest.raises(ValueError, match="every"):
        hand_ik(PANDA, PANDA, qpos, every=0)
