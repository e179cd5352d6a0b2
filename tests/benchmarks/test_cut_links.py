"""Links of two arms that are cut where either has a vertex."""

import mujoco
import numpy as np
import pytest

from benchmarks.common.cut_links import cut_alike
from mimic.arms.embodiment import load_mjcf, panda, planar_arm
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.similarity import centre_line_table
from tests.helpers.trees import TORSO_TIPS, torso


def middles(arm):
    """Arc lengths of the middles of the links of a serial arm, as fractions."""
    ends = np.cumsum(arm.link_lengths) / arm.link_lengths.sum()
    return ends - arm.link_lengths / arm.link_lengths.sum() / 2


def test_each_link_corresponds_to_one_with_its_middle_at_the_same_arc_length():
    one, other = cut_alike(planar_arm([0.3, 0.5, 0.2]), planar_arm([2.0, 1.0, 1.0, 1.0]))
    assert middles(one) == pytest.approx(middles(other))
    weights = np.asarray(arc_length_correspondence(one, other))
    assert np.count_nonzero(weights) == one.num_links == other.num_links == 5  # both have a vertex at 0.8
    assert np.all(np.diag(weights) > 0)


@pytest.mark.parametrize(
    "arm", [panda(locked=[3], links="merged"), load_mjcf(mujoco.MjModel.from_xml_string(torso()), tip=TORSO_TIPS)]
)
def test_joints_and_centre_line_stay_as_they_are(arm):
    other = planar_arm([1.0, 1.0]) if len(arm.chains) == 1 else arm
    cut, _ = cut_alike(arm, other)
    qpos = np.random.default_rng(0).uniform(-1, 1, (3, arm.num_joints))
    before, after = (centre_line_table(body, qpos) for body in (arm, cut))
    assert after.points == pytest.approx(before.points, abs=1e-6)
    assert cut.joint_names == arm.joint_names and len(cut.chains) == len(arm.chains)
