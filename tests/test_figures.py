"""Pictures: that they are made, that they show what they should, and what is refused."""

import numpy as np
import pytest

from mimic.envs.arms import ArmConfig
from mimic.rendering import ArmScene
from mimic.trainers.config import FiguresConfig
from mimic.trainers.figure_session import prepare_figures


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


@pytest.mark.slow
def test_figures_without_a_mapper(tmp_path):
    names = ["links", "correspondence", "similarity", "weights", "contours"]
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
            "expected some of links, correspondence, similarity, weights, contours, planar, panda",
        ),
        (FiguresConfig(out=__file__), "is a file"),
    ],
)
def test_bad_input_is_refused(config, message):
    with pytest.raises(ValueError, match=message):
        prepare_figures(config)
