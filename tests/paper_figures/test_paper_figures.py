"""Pictures: that they are made, that they show what they should, and what is refused."""

import numpy as np
import pytest

from mimic.arms.arm import ArmConfig
from mimic.arms.embodiment import planar_arm
from mimic.arms.rendering import ArmScene
from mimic.commands.config import FiguresConfig
from mimic.commands.figures import prepare_figures
from mimic.paper_figures import candidate_points
from mimic.paper_figures.planar_arms import joint_points


def red_share(image):
    red, green, blue = (image[..., channel].astype(int) for channel in range(3))
    return np.mean((red > 120) & (green < 70) & (blue < 70))


def test_locked_joints_are_red_and_arms_move():
    free, locked = ArmConfig(), ArmConfig(locked=[3, 6, 7])
    with ArmScene([free], width=160, height=120) as scene:
        still, moved = (scene.image([np.full(7, angle)]) for angle in (0.3, -0.6))
    assert still.shape == (120, 160, 3) and red_share(still) == 0
    assert np.mean(np.any(still != moved, axis=-1)) > 0.02
    with ArmScene([free, locked], width=160, height=120) as scene:
        both = scene.image([np.full(7, 0.3), np.full(4, 0.3)])
    left, right = both[:, :80], both[:, 80:]
    assert red_share(left) == 0 and red_share(right) > 0.002  # the expert stands on the left


def test_planar_arms_are_seen_from_above():
    arm = ArmConfig(model="planar", link_lengths=[0.5, 0.5])
    with ArmScene([arm], width=160, height=120) as scene:
        straight, bent = (scene.image([np.array(pose)]) for pose in ([0.0, 0.0], [1.5, 0.0]))
    assert np.mean(np.any(straight != bent, axis=-1)) > 0.005
    with ArmScene([arm, arm], width=160, height=120) as scene:
        straight, bent = (scene.image([np.array(pose), np.zeros(2)]) for pose in ([0.0, 0.0], [0.8, 0.0]))
    changed = np.any(straight != bent, axis=-1)
    assert changed[:, :80].any() and not changed[:, 80:].any()  # the expert stands on the left here too


def test_points_and_frames_disagree_on_what_is_perfect():
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


def test_a_planar_arm_is_drawn_through_its_joints_wherever_its_frames_sit():
    pose = np.array([0.5, -1.2])
    first = np.array([np.cos(0.5), np.sin(0.5)])
    drawn = np.stack([np.zeros(2), 0.25 * first, 0.25 * first + 0.75 * np.array([np.cos(-0.7), np.sin(-0.7)])])
    for frame_at in (0.0, 0.5, 1.0):
        points = joint_points(planar_arm([0.5, 1.5], frame_at=frame_at), pose)
        np.testing.assert_allclose(points, drawn, atol=1e-6)  # float32


@pytest.mark.slow
def test_figures_without_a_mapper(tmp_path):
    names = ["links", "correspondence", "points", "similarity", "weights", "contours"]
    assert prepare_figures(FiguresConfig(out=str(tmp_path), only=names))() == 0
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.{kind}" for name in names for kind in ("png", "pdf")}
    with pytest.raises(ValueError, match="exists; name another folder"):
        prepare_figures(FiguresConfig(out=str(tmp_path)))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (FiguresConfig(), "out: expected a folder"),
        (
            FiguresConfig(out="new", only=["contour"]),
            "expected some of links, correspondence, similarity, points, weights, contours, planar, panda",
        ),
        (FiguresConfig(out=__file__), "is a file"),
    ],
)
def test_bad_input_is_refused(config, message):
    with pytest.raises(ValueError, match=message):
        prepare_figures(config)
