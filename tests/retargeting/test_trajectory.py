"""Motions that change from one track of minima to another."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from mimic.arms.embodiment import planar_arm
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.distance import DistanceWeights
from mimic.retargeting.optimizers import Solution
from mimic.retargeting.trajectory import _best_path, imitate_trajectory

TIMES = 40
NEVER, ALWAYS = np.array([False]), np.array([True])


def two_tracks(gap: float) -> Solution:
    """Tracks at angles 0 and `gap`: the first is better by 1 in the first half, the second in the other."""
    late = (np.arange(TIMES) >= TIMES // 2).astype(np.float32)
    qpos = np.array([0.0, gap], np.float32)[:, None, None] * np.ones((1, TIMES, 1), np.float32)
    value = np.stack([late, 1 - late])
    return Solution(jnp.asarray(qpos), jnp.asarray(value), jnp.zeros((2, TIMES)))


def path(tracks: Solution, jump: float, continuous: np.ndarray, cost: float) -> np.ndarray:
    return np.asarray(_best_path(tracks, jnp.array([jump]), continuous, jnp.float32(cost)))[:, 0]


def test_a_path_changes_track_only_where_that_pays():
    """The change takes 10 steps, and gains 1 at each of 20 times."""
    tracks = two_tracks(gap=1.0)
    np.testing.assert_array_equal(path(tracks, 0.1, NEVER, 1.9), np.arange(TIMES) >= TIMES // 2)
    assert len(np.unique(path(tracks, 0.1, NEVER, 2.1))) == 1


def test_full_revolutions_of_continuous_joints_do_not_count():
    tracks = two_tracks(gap=2 * np.pi)
    assert len(np.unique(path(tracks, 0.1, NEVER, 1.0))) == 1
    assert len(np.unique(path(tracks, 0.1, ALWAYS, 1.0))) == 2


def test_a_joint_swings_back_where_the_expert_passes_its_limit():
    """The expert turns past pi and stays there. At its limit the learner is near, and on the other side it matches."""
    expert = planar_arm([1.0])
    learner = dataclasses.replace(expert, joint_range=np.array([[-3.0, 3.0]]))
    qpos = np.concatenate([np.full(150, 2.5), np.linspace(2.5, 2 * np.pi - 2.5, 20), np.full(150, 2 * np.pi - 2.5)])
    matrix, weights = arc_length_correspondence(expert, learner), DistanceWeights(rotation=1.0)
    motion = imitate_trajectory(expert, learner, qpos[:, None], matrix, weights, largest_jump=0.2, starts=3)
    assert np.abs(np.diff(np.asarray(motion.qpos), axis=0)).max() <= 0.2 + 1e-5
    # 5 rad in steps of 0.2 are 25 times, from the end of the turn or before it.
    np.testing.assert_allclose(motion.distance[:150], 0, atol=1e-5)
    np.testing.assert_allclose(motion.distance[200:], 0, atol=1e-5)
    assert np.all(np.asarray(motion.qpos)[200:] < -2) and not np.any(np.asarray(motion.converged)[175:190])


def test_the_first_pose_lies_within_half_a_revolution():
    """Later poses of joints without limits may pass pi, as the expert does."""
    arm = planar_arm([1.0])
    qpos = np.linspace(3.5, 4.5, 6)[:, None]
    motion = imitate_trajectory(arm, arm, qpos, np.eye(1), DistanceWeights(rotation=1.0), starts=1)
    np.testing.assert_allclose(motion.qpos, qpos - 2 * np.pi, atol=1e-3)  # float32, at a flat minimum
