"""Upper arm, forearm and hand point where the expert's do, as nearly as the learner's joints allow."""

import numpy as np
import pytest

from benchmarks.peers.segment_alignment import (
    Landmarks,
    align_segments,
    landmarks,
    part_directions,
    part_joints,
)
from benchmarks.peers.subproblems import bend_to_angle, rotate_onto, rotate_onto_by_two
from mimic.arms.embodiment import Embodiment, panda, planar_arm
from tests.retargeting.test_pose_baselines import PANDA, motion

PANDA_MARKS = Landmarks(1, 3, 5, 7)  # (0,0,.333), (.0825,0,.649), (0,0,1.033) and the tip
ROUNDING = 1e-6  # rad, of angles near 0 by way of a cosine in double precision (1e-8), and of float32 (1e-7)


def part_angles(expert: Embodiment, learner: Embodiment, marks: Landmarks, qpos, learner_qpos) -> np.ndarray:
    """Angles between the directions of upper arm, forearm and hand, [3, poses]."""
    pair = ((expert, qpos), (learner, learner_qpos))
    a, b = (part_directions(arm, marks, q.reshape(-1, arm.num_joints)) for arm, q in pair)
    return 2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2, 0, 1))


def test_landmarks_of_the_panda():
    assert landmarks(PANDA) == PANDA_MARKS
    assert [part.joints for part in part_joints(PANDA, PANDA_MARKS)] == [(0, 1), (2, 3), (4, 5)]


def test_an_arm_without_elbow_has_no_landmarks():
    assert landmarks(planar_arm([0.5, 0.5])) is None
    assert align_segments(PANDA, planar_arm([0.5, 0.5]), motion(PANDA, 2)) is None


def test_the_panda_aligns_with_itself():
    qpos = motion(PANDA, 300)
    poses = align_segments(PANDA, PANDA, qpos)
    assert part_angles(PANDA, PANDA, PANDA_MARKS, qpos, poses).max() < ROUNDING


@pytest.mark.parametrize("locked", [(1,), (2,), (3,), (4,), (5,), (6,), (7,), (3, 6, 7), (2, 3, 6, 7), (1, 4)])
def test_aligning_a_part_is_no_worse_than_leaving_it_at_home(locked):
    """Each part, against the pose with the joints that orient it at home."""
    learner = panda(locked=locked)
    qpos = motion(PANDA, 200)
    poses = align_segments(PANDA, learner, qpos)
    angles = part_angles(PANDA, learner, PANDA_MARKS, qpos, poses)
    parts = part_joints(learner, PANDA_MARKS)
    assert poses is not None and any(part.joints for part in parts)
    for part, (joints, _) in enumerate(parts[1:], start=1):  # the forearm's roll joint may move the upper arm
        unmoved = poses.copy()
        unmoved[..., list(joints)] = 0
        still = part_angles(PANDA, learner, PANDA_MARKS, qpos, unmoved)[part]
        assert np.all(angles[part] <= still + ROUNDING)


def test_solutions_within_the_joint_range_come_first():
    learner = panda(limits="hardware")
    lower, upper = learner.joint_range.T
    qpos = np.random.default_rng(0).uniform(lower, upper, (300, 1, 7))
    poses = align_segments(learner, learner, qpos)
    assert poses is not None and np.all((poses >= lower) & (poses <= upper))
    angles = part_angles(learner, learner, PANDA_MARKS, qpos, poses)
    # The expert's own pose is within the range. The upper arm and forearm are solved with four joints, and of their
    # four solutions one is within it; the hand's two joints are chosen after them, which may leave it none.
    assert np.mean(angles[:2].max(axis=0) < ROUNDING) > 0.99


@pytest.mark.slow_for("True")
@pytest.mark.parametrize("reachable", [True, False])
def test_subproblem_2_minimises_the_angle(reachable):
    """Against a grid over both angles."""
    rng = np.random.default_rng(1)
    first, second, vector, goal = rng.normal(size=(4, 20, 3))
    first, second, vector, goal = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (first, second, vector, goal))
    if not reachable:
        second = first + 0.2 * second
        second /= np.linalg.norm(second, axis=1, keepdims=True)

    def turned(a, b):
        return rotated(first, a, rotated(second, b, vector))

    grid = np.linspace(-np.pi, np.pi, 73)
    best = np.max([np.sum(turned(a, b) * goal, axis=1) for a in grid for b in grid], axis=0)
    for a, b in rotate_onto_by_two(first, second, vector, goal):
        reached = np.sum(turned(a[:, None], b[:, None]) * goal, axis=1)
        assert np.all(reached >= best - 1e-12)
    if not reachable:
        assert np.any(best < 0.99)


def test_subproblem_1_minimises_the_angle():
    rng = np.random.default_rng(2)
    axis, vector, goal = rng.normal(size=(3, 40, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    reached = np.sum(rotated(axis, rotate_onto(axis, vector, goal)[:, None], vector) * goal, axis=1)
    best = np.max([np.sum(rotated(axis, a, vector) * goal, axis=1) for a in np.linspace(-np.pi, np.pi, 1001)], axis=0)
    assert np.all(reached >= best - 1e-12)


def test_bending_makes_the_angle():
    rng = np.random.default_rng(3)
    axis, vector, other = rng.normal(size=(3, 40, 3))
    axis, vector, other = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (axis, vector, other))
    cosine = np.sum(rotated(axis, 0.7, vector) * other, axis=1)  # so that it can be reached
    for bend in bend_to_angle(axis, vector, other, cosine):
        np.testing.assert_allclose(np.sum(rotated(axis, bend[:, None], vector) * other, axis=1), cosine, atol=1e-12)


def rotated(axis, angle, vector):
    """Rodrigues' formula, [n, 3]."""
    along = np.sum(axis * vector, axis=1, keepdims=True) * axis
    return along + np.cos(angle) * (vector - along) + np.sin(angle) * np.cross(axis, vector)


def test_aligning_takes_known_landmarks():
    """The upper arm of the expert is then between other vertices, so that the learner's points elsewhere."""
    qpos = motion(PANDA, 4, spread=1.0)
    other = Landmarks(1, 2, 5, 7)
    poses = align_segments(PANDA, PANDA, qpos, expert_marks=other)
    assert part_angles(PANDA, PANDA, other, qpos, poses)[0].max() < ROUNDING
    default = align_segments(PANDA, PANDA, qpos)
    assert poses is not None and default is not None and not np.allclose(poses, default, atol=1e-3)
