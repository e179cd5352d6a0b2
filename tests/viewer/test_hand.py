"""The expert's hand follows a drag."""

import numpy as np
import pytest

import mimic
from mimic.viewer.hand import hand_position, pose_of_hand


@pytest.mark.parametrize("limits", ["none", "hardware"])
def test_the_hand_reaches_a_position_that_another_pose_reaches(limits):
    arm = mimic.panda(limits=limits)
    start = np.asarray(arm.home) + 0.1
    target = hand_position(arm, start + 0.3)
    pose = pose_of_hand(arm, start, target)
    np.testing.assert_allclose(hand_position(arm, pose), target, atol=2e-3)  # m; a little is given for staying near
    assert np.all((pose >= arm.joint_range[:, 0]) & (pose <= arm.joint_range[:, 1]))


def test_the_hand_comes_near_a_position_out_of_reach():
    arm = mimic.planar_arm([0.5, 0.5])
    hand = hand_position(arm, pose_of_hand(arm, np.array([0.3, 0.4]), np.array([0.0, 3.0, 0.0])))
    np.testing.assert_allclose(hand, [0, 1, 0], atol=0.02)
