"""Poses of a hand as WebXR and OpenXR give them, and the example that drives an arm by them."""

import contextlib
import json
import socket
import subprocess
import sys
import time

import mujoco
import numpy as np
import pytest

import mimic
from mimic.motions.mocap.live_points import Sample, parse_sample
from mimic.motions.mocap.point_socket import PointListener
from tests.helpers.repository import REPOSITORY

sys.path.append(str(REPOSITORY / "examples"))

import xr_teleoperation  # noqa: E402  # pyright: ignore[reportMissingImports]

FORWARD = [1.0, 0.0, 0.0, 0.0]  # a controller of which -z, its ray, points forward


def hand_of(*arguments, **more):
    hand = parse_sample(line(*arguments, **more)).hand
    assert hand is not None
    return hand


def line(position, wxyz=FORWARD, **more):
    return json.dumps({"time": 0.1, "hand": {"position": list(position), "wxyz": list(wxyz)}, **more}).encode()


def test_axes_of_a_headset():
    """A hand 1.2 m up, 0.3 m ahead and 0.1 m to the right, that points forward and opens sideways."""
    pose = hand_of([0.1, 1.2, -0.3], frame="xr").pose
    np.testing.assert_allclose(pose[:3, 3], [0.3, -0.1, 1.2])
    np.testing.assert_allclose(pose[:3, 2], [1, 0, 0], atol=1e-12)  # approach: forward
    np.testing.assert_allclose(pose[:3, 0], [0, -1, 0], atol=1e-12)  # opening: to the right
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    half = np.sqrt(0.5)  # raised by 90 degrees about x, which points right
    raised = hand_of([0, 0, 0], [half, half, 0, 0], frame="xr").pose
    np.testing.assert_allclose(raised[:3, 2], [0, 0, 1], atol=1e-12)


def test_quaternions_are_mujoco_s():
    wxyz, matrix = np.array([0.5, -0.1, 0.7, 0.5]), np.zeros(9)
    wxyz /= np.linalg.norm(wxyz)
    mujoco.mju_quat2Mat(matrix, wxyz)
    hand = hand_of([1, 2, 3], wxyz, gripper=0.25)
    np.testing.assert_allclose(hand.pose[:3], np.column_stack([matrix.reshape(3, 3), [1, 2, 3]]), atol=1e-12)
    assert hand.gripper == 0.25


@pytest.mark.parametrize(("bad", "message"), [
    (line([0, 1]), "position"),
    (line([0, 0, float("nan")]), "position"),
    (line([0, 0, 0], [0, 0, 0, 0]), "length 1, got 0"),
    (line([0, 0, 0], frame="y_up"), "frame: expected one of xr, mimic, got 'y_up'"),
    (line([0, 0, 0], gripper="open"), "gripper: expected a finite number"),
    (b'{"time": 0, "hand": 3}', "'points' or 'hand'"),
])  # fmt: skip
def test_what_is_no_hand_says_why(bad, message):
    with pytest.raises(ValueError, match=message):
        parse_sample(bad)


def test_a_headset_drives_an_arm(tmp_path):
    """Forward and right in the headset's space are forward and right of the arm; a gap opens the clutch."""
    for package in ("ruckig", "pyarrow"):
        pytest.importorskip(package, reason=f"needs {package}")
    panda, commands = mimic.panda(limits="hardware"), []
    operator = xr_teleoperation.follow_hand("panda", 100.0, None)
    recorder = mimic.TeleoperationRecorder(operator)
    start = mimic.hand_frames(panda, operator.qpos)
    with contextlib.closing(PointListener("localhost", 0)) as listener:
        with socket.create_connection(("localhost", listener.port)) as headset:
            for tick in range(40):
                moved = min(tick / 30, 1)
                content = {"position": [0.05 * moved, 1.2, -0.1 * moved], "wxyz": FORWARD}
                sample = {"time": 0.01 * tick, "hand": content, "frame": "xr", "gripper": 0.5}
                headset.sendall(json.dumps(sample).encode() + b"\n")
                while listener.counts.received <= tick:
                    time.sleep(1e-3)
                xr_teleoperation.drive(listener, operator, commands.append, recorder)
        for _ in range(100):  # no further sample: it catches up
            commands.append(recorder.step(None))
        moved = mimic.hand_frames(panda, commands[-1].qpos).position - start.position
        np.testing.assert_allclose(moved, [[0.1, -0.05, 0]], atol=1e-3)
        assert commands[-1].gripper == 0.5 and recorder.episodes == 1
        listener._arrived = -1e3
        xr_teleoperation.drive(listener, operator, commands.append, recorder)
        assert commands[-1].status.state == "disengaged"
    recorder.write(tmp_path / "driven")  # of the follower alone, as a hand has no joints
    info = json.loads((tmp_path / "driven/meta/info.json").read_text())
    assert info["total_episodes"] == 1 and not any("expert" in name for name in info["features"])


def test_a_hand_whose_space_is_recentred_leads_from_there():
    """The pose of a hand that has jumped by 1 m opens the clutch, and the next one closes it: the arm stays."""
    pytest.importorskip("ruckig", reason="needs ruckig")
    operator, commands = xr_teleoperation.follow_hand("panda", 100.0, None), []

    class Listener:
        silence = 0.0

        def take(self):
            hand = hand_of([0.0, 1.2, 0.0 if len(commands) < 20 else -1.0], frame="xr")
            return Sample(0.01 * len(commands), {}, hand)

    for _ in range(60):
        xr_teleoperation.drive(Listener(), operator, commands.append)
    assert commands[20].status.reason.endswith("jumped") and operator.engagements == 2
    assert {command.status.state for command in commands[21:]} == {"tracking"}
    np.testing.assert_allclose([command.qpos for command in commands[20:]], [commands[0].qpos] * 40, atol=1e-6)


def test_a_folder_that_exists_is_one_line_before_driving(tmp_path):
    command = [sys.executable, REPOSITORY / "examples/xr_teleoperation.py", "panda", "--record", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, timeout=120)
    assert done.returncode == 1 and done.stderr.startswith("error: record: ") and done.stderr.count("\n") == 1
