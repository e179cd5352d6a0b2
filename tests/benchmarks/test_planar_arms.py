"""Pictures of planar arms: colours of corresponding links, and one scale for all panels."""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pytest

from benchmarks.figures.planar_arms import draw_match, fit, joint_points
from mimic.arms.embodiment import planar_arm
from mimic.arms.link_match import LinkMatch

EXPERT, LEARNER = planar_arm([0.5, 0.25, 0.25]), planar_arm([1.0, 1.0])
POSES = np.array([0.3, 0.8, -0.4]), np.array([0.5, 0.2])


@pytest.fixture
def panels():
    figure, panels = plt.subplots(1, 2)
    yield panels
    plt.close(figure)


def test_corresponding_links_have_one_colour(panels):
    match = LinkMatch(EXPERT, LEARNER, np.array([[1, 0], [0, 0.5], [0, 0.5]]))
    draw_match(panels[0], match, *POSES)
    links = [line for line in panels[0].lines if line.get_marker() != "o"]
    ends = [np.transpose(line.get_data()) for line in links]
    colours = [line.get_color() for line in links]
    for arm, pose, drawn in ((EXPERT, POSES[0], ends[:3]), (LEARNER, POSES[1], ends[3:])):
        points = joint_points(arm, pose)
        np.testing.assert_allclose(drawn, np.stack([points[:-1], points[1:]], axis=1))
    np.testing.assert_allclose(colours[3], colours[0])
    np.testing.assert_allclose(colours[4], np.mean(colours[1:3], axis=0))


def test_all_panels_have_one_scale_and_show_their_arms(panels):
    panels[0].plot([0, 1], [0, 0.2])
    panels[1].plot([5, 5.5], [0, 2])
    fit(panels)
    sizes = [(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())) for axes in panels]
    np.testing.assert_allclose(sizes[0], sizes[1])
    for axes in panels:
        for limits, data in zip((axes.get_xlim(), axes.get_ylim()), axes.lines[0].get_data(), strict=True):
            assert limits[0] < min(data) and max(data) < limits[1]
