"""The picture of candidate points: which poses are optimal by points and by frames."""

import numpy as np
import pytest

from benchmarks.figures import candidate_points
from benchmarks.figures.planar_arms import joint_points


@pytest.mark.slow
def test_candidate_points_and_frames_have_different_optima():
    expert, mirrored, parallel = candidate_points.poses().values()
    itself, same_hand, same_directions = (
        candidate_points.distances(expert, arm) for arm in (expert, mirrored, parallel)
    )
    rounding = 1e-6  # of float32, for lengths and angles of about 1
    assert max(itself.values()) < rounding
    assert same_hand["points"] < rounding and same_hand["frames"] > 1.5  # rad; a right angle is pi / 2
    assert same_directions["frames"] < rounding and same_directions["points"] > 0.3  # chain lengths
    tips = [joint_points(posed.arm, posed.qpos)[-1] for posed in (expert, parallel)]
    assert same_directions["points"] == pytest.approx(np.linalg.norm(tips[0] - tips[1]), abs=rounding)
