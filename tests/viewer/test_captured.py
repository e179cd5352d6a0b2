"""Captured motions that move a live view: the player of a clip, and the tracker of points."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from mimic.motions.mocap.arms import find_arms
from mimic.motions.mocap.ball_chain import zero_frames
from mimic.motions.mocap.link_motion import arm_motion
from mimic.motions.mocap.live_hand import LiveHand
from mimic.motions.mocap.live_points import LiveArm, Sample, live_body
from mimic.motions.mocap.point_socket import Counts
from mimic.viewer.captured import Clip, ClipPlayer, HandTracker, PointTracker, Said, make_clip
from tests.helpers.bodies import RATE, person


@pytest.fixture
def clip():
    """Two parts of 3 and 2 samples, 0.125 s apart, from 0 s and from 1 s; binary fractions, to be exact."""
    return Clip([0.0, 1.0], [np.array([[0.0], [1.0], [2.0]]), np.array([[5.0], [6.0]])], 0.125)


@pytest.mark.parametrize(
    ("time", "angle"),
    [(0.0, 0.0), (0.0625, 0.5), (0.25, 2.0), (0.7, 2.0), (1.0, 5.0), (1.0625, 5.5), (9.0, 6.0), (-1, 0)],
)
def test_poses_of_a_clip(clip, time, angle):
    assert clip.pose(time)[0] == pytest.approx(angle)
    assert clip.duration == pytest.approx(1.125)


def test_a_clip_is_slowed_down():
    body = person(60)
    motion = arm_motion(body)
    zero = zero_frames(motion)
    clip = make_clip([motion.cut(0, 20), motion.cut(30, 60)], [2.0, 2.5], zero, slow_down=3.0, cutoff=np.inf)
    assert clip.starts == [0.0, 1.5] and clip.interval == pytest.approx(3 / RATE)
    np.testing.assert_allclose(clip.pose(1.5 + 3 * 4 / RATE), clip.poses[1][4], atol=1e-9)


def test_a_player_plays_and_says_where_it_jumps(clip):
    player = ClipPlayer(clip)
    poses, jumps = zip(*[player.advance(0.125) for _ in range(12)], strict=True)
    assert [pose is not None for pose in poses] == [True] * 12
    assert [i for i, jumped in enumerate(jumps) if jumped] == [0, 7, 9]  # its start, the second part, its repetition
    assert poses[9][0] == 0.0 and poses[10][0] == 1.0


def test_a_paused_player_computes_nothing(clip):
    player = ClipPlayer(clip)
    player.advance(0.1)
    player.timeline.is_playing = False
    assert player.advance(0.1) == (None, False)
    player.timeline.go_to(1.0625)
    pose, jumped = player.advance(0.1)
    assert pose is not None and pose[0] == pytest.approx(5.5) and jumped
    player.timeline.go_to(float("nan"))
    assert player.advance(0.1) == (None, False)


class Listener:
    """Samples that are taken one by one."""

    counts = Counts(7, 2, 0, 1)
    silence, is_connected = 0.0, True

    def __init__(self, samples):
        self._samples = list(samples)

    def take(self):
        return self._samples.pop(0) if self._samples else None


def test_a_tracker_holds_its_pose_where_points_are_missing_or_wrong(capsys):
    body = person(10)
    samples = [Sample(i / RATE, dict(zip(body.names, row, strict=True))) for i, row in enumerate(body.positions)]
    arm = LiveArm(find_arms(live_body(samples[0])), "right", 1.0, "z", 0.0, (0.0, 0.0, 0.0))
    arm = dataclasses.replace(arm, zero=zero_frames(arm.motion(samples)))
    unseen = Sample(1.0, {**samples[2].points, "RightHand": np.full(3, np.nan)})
    together = Sample(1.0, {**samples[2].points, "RightHand": samples[2].points["RightForeArm"]})
    listener = Listener([samples[0], unseen, together, samples[1], together])
    tracker = PointTracker(listener, arm)  # type: ignore[arg-type]
    first, second, third, fourth, fifth = (tracker.advance(0.02) for _ in range(5))
    assert first[0] is not None and first[1]  # the first pose may be anywhere
    assert second == third == fifth == (None, False)
    assert fourth[0] is not None
    np.testing.assert_allclose(fourth[0], arm.pose(samples[1]))
    assert not fourth[1] and (tracker.incomplete, tracker.unusable) == (1, 2)
    faults = "2 bad lines, 1 without all points of the arm, 2 that are no pose of it, 1 rejected connections"
    assert tracker.summary == f"7 samples, {faults}"
    assert capsys.readouterr().err.splitlines() == [
        "view: points: expected those of a link apart; the arms hold their pose"
    ]


def test_a_hand_drags_the_arm_s_from_where_both_are():
    """Poses after a pause move nothing at first, as the hand may then be anywhere."""
    turned, arm_hand = np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])
    turned[:3, :3], turned[:3, 3], arm_hand[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0.1, 0, 0.2], [0.5, 0, 0.4]
    samples = [Sample(t, {}, LiveHand(pose, 0.5)) for t, pose in enumerate([np.eye(4), turned, turned])]
    tracker = HandTracker(Listener([*samples[:2], Sample(2.0, {}), samples[2]]))  # type: ignore[arg-type]
    goals: list[Any] = [tracker.advance(dt, lambda: arm_hand) for dt in (0.1, 0.1, 2.0, 0.1)]
    np.testing.assert_allclose(goals[0], arm_hand)
    expected = np.array([[0, 1, 0, 0.6], [1, 0, 0, 0], [0, 0, -1, 0.6], [0, 0, 0, 1]])
    np.testing.assert_allclose(goals[1], expected, atol=1e-12)
    assert goals[2] is None
    np.testing.assert_allclose(goals[3], arm_hand)
    assert tracker.gripper == 0.5
    assert tracker.state == "poses of a hand arrive"


def test_a_kind_of_fault_is_said_once(capsys):
    say = Said()
    for line in ("time: expected more than 1.5 s, got 1", "time: expected more than 2 s, got 1e-3", "arm: none"):
        say(line)
    assert capsys.readouterr().err.splitlines() == ["view: time: expected more than 1.5 s, got 1", "view: arm: none"]


def test_a_sender_that_stops_is_said():
    tracker = PointTracker(listener := Listener([]), None)  # type: ignore[arg-type]
    assert tracker.state == "points arrive"
    listener.silence = 2.0
    assert tracker.state == "the sender is silent, the arms hold their pose"
    listener.is_connected = False
    assert tracker.state == "no sender is connected, the arms hold their pose"
