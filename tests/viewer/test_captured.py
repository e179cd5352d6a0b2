"""Points and poses of a hand that move a live view."""

import dataclasses
from typing import Any

import numpy as np

from mimic.motions.mocap.arms import find_arms
from mimic.motions.mocap.ball_chain import zero_frames
from mimic.motions.mocap.live_hand import LiveHand
from mimic.motions.mocap.live_points import LiveArm, Sample, live_body
from mimic.motions.mocap.point_socket import Counts
from mimic.viewer.captured import HandTracker, PointTracker, Said
from tests.helpers.bodies import RATE, person


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
