"""Inverse kinematics of matched frames follows an arm that the learner can follow exactly."""

import numpy as np

from benchmarks.peers.frame_matching import match_frames
from benchmarks.peers.landmarks import landmarks, part_directions
from mimic.arms.embodiment import panda


def test_matched_frames_have_the_directions_of_the_parts():
    """The same arm in a motion from its home pose, of which upper arm, forearm and hand point where the expert's do."""
    arm = panda(limits="hardware")
    marks = landmarks(arm)
    assert marks is not None
    goal = np.asarray(arm.home) + np.array([0.3, -0.2, 0.2, 0.3, -0.2, 0.2, 0.0])
    qpos = np.linspace(arm.home, goal, 20)
    matched = match_frames(arm, arm, qpos, marks)
    assert matched is not None and matched.shape == qpos.shape
    one, other = (part_directions(arm, marks, poses) for poses in (qpos, matched))
    # 2 degrees: positions weigh more, and parts of the Panda change in length by a hand's width.
    assert np.degrees(np.arccos(np.clip((one * other).sum(axis=-1), -1, 1))).max() < 2
    assert np.abs(np.diff(matched, axis=0)).max() < 0.1
