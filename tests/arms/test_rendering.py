"""Pictures of arms."""

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from mimic.arms import rendering
from mimic.arms.arm import ArmConfig
from mimic.arms.link_match import Capsule
from mimic.arms.rendering import ArmScene

PLANAR = ArmConfig(model="planar", link_lengths=[0.5, 0.5])


def test_a_missing_graphics_library_is_one_line(monkeypatch):
    def choose():
        raise AttributeError("no\neglQueryString")

    monkeypatch.setattr(rendering, "_choose_window_system", choose)
    with pytest.raises(ValueError, match="^rendering: no OpenGL library works; expected EGL .*: no eglQueryString$"):
        ArmScene([PLANAR])


@pytest.mark.slow
def test_a_missing_graphics_library_is_reported_when_something_is_drawn(tmp_path):
    """PyOpenGL fails in this way where there is no libGL."""
    (tmp_path / "OpenGL").mkdir()
    (tmp_path / "OpenGL" / "__init__.py").write_text("import ctypes\nraise ctypes.ArgumentError('no glGetError')")
    code = "from mimic import ArmConfig, ArmScene; import mujoco.mjx; ArmScene([ArmConfig()])"
    found = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}", "MUJOCO_GL": "egl"}
    ended = subprocess.run([sys.executable, "-c", code], env=found, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1].startswith("ValueError: rendering: no OpenGL library works; expected EGL")


def red_share(image):
    red, green, blue = (image[..., channel].astype(int) for channel in range(3))
    return np.mean((red > 120) & (green < 70) & (blue < 70))


def test_locked_joints_are_red_and_arms_move():
    free, locked = ArmConfig(), ArmConfig(locked=[3, 6, 7])
    with ArmScene([free, locked], width=160, height=120) as scene:
        still, moved = (scene.image([np.full(7, angle), np.full(4, angle)]) for angle in (0.3, -0.6))
    assert still.shape == (120, 160, 3) and np.mean(np.any(still != moved, axis=-1)) > 0.02
    left, right = still[:, :80], still[:, 80:]
    assert red_share(left) == 0 and red_share(right) > 0.002  # the expert stands on the left


def test_planar_arms_are_seen_from_above():
    with ArmScene([PLANAR, PLANAR], width=160, height=120) as scene:
        straight, bent = (scene.image([np.array(pose), np.zeros(2)]) for pose in ([0.0, 0.0], [0.8, 0.0]))
    changed = np.any(straight != bent, axis=-1)
    assert np.mean(changed) > 0.005
    assert changed[:, :80].any() and not changed[:, 80:].any()  # the expert stands on the left here too


def test_points_as_the_camera_sees_them():
    with ArmScene([ArmConfig()], width=32, height=32) as scene:
        up, aside, ahead = scene.flattened(np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]]))
    assert up[1] > 0.9 and abs(up[0]) < 1e-12  # seen from slightly above, upright
    assert aside[0] > 0.9  # the camera looks against the x-axis, so that y is to its right
    assert abs(ahead[0]) < 0.3 and ahead[1] < 0  # x comes towards it, and down as it looks from above


@pytest.mark.slow_for("False")
@pytest.mark.parametrize("is_software", [True, False])
def test_videos_are_plain_where_the_cpu_renders(monkeypatch, is_software):
    monkeypatch.setattr(rendering, "is_software_renderer", lambda: is_software)
    for fast in (True, False):
        with ArmScene([PLANAR], width=32, height=32, fast=fast) as scene:
            is_plain = fast and is_software
            assert scene._renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_SHADOW)] == (not is_plain)
            assert bool(scene._model.vis.quality.offsamples) == (not is_plain)


def test_fitted_arms_fill_the_image():
    """The arms at rest and bent, with a margin: a part of the background on all sides, and no wide empty frame."""
    motion = np.linspace(0, 0.7, 5)[:, None] * np.ones(2)
    with ArmScene([PLANAR, PLANAR], width=240, height=160) as scene:
        scene.fit([motion, -motion])
        images = np.stack([scene.image([pose, -pose]) for pose in motion]).astype(int)
        left, right = scene.centres()
    assert 0.15 < left < 0.45 and 0.55 < right < 0.85
    moved = np.any(np.abs(images - images[0]).max(axis=-1) > 30, axis=0)
    assert not moved[:3].any() and not moved[-3:].any() and not moved[:, :3].any() and not moved[:, -3:].any()
    assert np.ptp(np.flatnonzero(moved.any(axis=0))) > 100


def test_the_floor_is_below_an_arm_that_reaches_below_its_base():
    down, up = (np.array([0.0, angle, 0, 0, 0, 0]) for angle in (2.8, 0.0))
    with ArmScene([ArmConfig(locked=[6])], width=160, height=120) as scene:
        scene.fit([down[None]])
        assert red_share(scene.image([down])) > 0.002  # the locked joint, near the hand
        scene.fit([up[None]])
        assert red_share(scene.image([up])) > 0 and scene._data.mocap_pos[0, 2] == 0


def test_an_overlay_is_drawn_at_the_last_arm():
    capsule = Capsule(np.zeros(3), np.array([0, 0, 0.2]), 0.1, (1.0, 0.0, 0.0, 1.0))
    with ArmScene([PLANAR, PLANAR], width=160, height=120) as scene:
        image = scene.image([np.zeros(2), np.zeros(2)], [capsule])
    assert red_share(image[:, 80:]) > 0.002 and red_share(image[:, :80]) == 0


def test_an_image_has_pixels():
    with pytest.raises(ValueError, match="width, height: expected at least 1 pixel, got -1, 480"):
        ArmScene([ArmConfig()], width=-1)
