"""Points that arrive one sample at a time: their lines of JSON, and the pose of an arm in each."""

import dataclasses

import numpy as np
import pytest

from mimic.motions.mocap.arms import find_arms
from mimic.motions.mocap.ball_chain import ball_chain_motion, ball_chain_pose, ball_chain_xml, zero_frames
from mimic.motions.mocap.link_motion import arm_motion, motion_states
from mimic.motions.mocap.live_points import LiveArm, Sample, live_body, parse_sample, sample_line
from mimic.motions.mocap.points import PointMotion
from tests.helpers.bodies import RATE, person

TURN = 0.3, -0.2, 0.1


@pytest.fixture(scope="module")
def body():
    return person(40)


@pytest.fixture(scope="module")
def samples(body):
    return [Sample(i / RATE, dict(zip(body.names, row, strict=True))) for i, row in enumerate(body.positions)]


@pytest.fixture(scope="module")
def arm(samples):
    """The right arm, turned, on a trunk."""
    arm = LiveArm(find_arms(live_body(samples[0])), "right", 1.0, "z", 0.2, TURN)
    return dataclasses.replace(arm, zero=zero_frames(arm.motion(samples)))


def test_a_sample_comes_back_from_its_line(samples):
    points = {**samples[3].points, "unseen": np.full(3, np.nan)}
    line = sample_line(Sample(1.5, points))
    assert line.endswith(b"\n") and line.count(b"\n") == 1
    sample = parse_sample(line)
    assert sample.time == 1.5 and list(sample.points) == list(points)
    for name in points:
        np.testing.assert_array_equal(sample.points[name], points[name])


def test_points_count_whatever_hand_is():
    for hand in (b"3", b"null", b'{"position": [0, 0, 0]}'):
        sample = parse_sample(b'{"time": 1, "points": {"a": [1, 2, 3]}, "hand": %s}' % hand)
        assert list(sample.points) == ["a"] and sample.hand is None


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"GET / HTTP/1.1", "a line of JSON"),
        (b"[" * 100_000, "a line of JSON"),
        (b'{"time": 1}', "an object with"),
        (b'{"time": 1, "points": [[1, 2, 3]]}', "an object with"),
        (b'{"time": NaN, "points": {}}', "time: expected a finite number"),
        (b'{"time": 1, "points": {"a": [1, 2]}}', "three numbers or null for 'a'"),
        (b'{"time": 1, "points": {"a": [1, 2, true]}}', "three numbers or null for 'a'"),
        (b'{"time": 1, "points": {"a": [1, 2, null]}}', "three numbers or null for 'a'"),
        (b'{"time": 1, "points": {"a": [1, 2, 1e999]}}', "at most 1e\\+06 for 'a'"),
        (b'{"time": 1, "points": {"a": [1, 2, %s]}}' % (b"9" * 400), "for 'a'"),
        (b'{"time": 1, "points": {"%s": null}}' % (b"a" * 300), "names of at most"),
        (b'{"time": 1, "points": {%s}}' % b",".join(b'"%d": null' % i for i in range(3000)), "at most 2000"),
    ],
)
def test_what_is_no_sample_is_one_line(line, message):
    with pytest.raises(ValueError, match=message) as raised:
        parse_sample(line)
    assert "\n" not in str(raised.value)


def test_poses_of_single_samples_are_those_of_the_motion(arm, samples, tmp_path):
    """Link directions, through the model of the arm and through the filter-free motion."""
    import mimic
    from mimic.metric.kinematics import link_state_table

    links = arm.motion(samples)
    (tmp_path / "arm.xml").write_text(ball_chain_xml(links, arm.zero))
    model = mimic.load_mjcf(tmp_path / "arm.xml")
    poses = np.array([arm.pose(sample) for sample in samples])
    states = link_state_table(model, poses, np.zeros_like(poses))
    seen = np.asarray(states.direction)
    np.testing.assert_allclose(seen, np.asarray(motion_states(links, cutoff=np.inf).direction), atol=2e-6)
    offline = ball_chain_motion(links, arm.zero, cutoff=np.inf)[0]
    of_motion = link_state_table(model, offline, np.zeros_like(offline))
    np.testing.assert_allclose(seen, np.asarray(of_motion.direction), atol=2e-6)


def test_live_links_are_those_of_a_clip(body, arm, samples):
    from mimic.motions.mocap.clips import turned

    clip = turned(arm_motion(body, "right", trunk=0.2, cutoff=np.inf), *TURN)
    live = arm.motion(samples)
    assert live.names == clip.names == ("trunk", "upper_arm", "forearm", "hand")
    np.testing.assert_allclose(live.end, clip.end, atol=1e-12)


def test_a_pose_turns_no_link_about_itself(arm, samples):
    assert np.abs(arm.pose(samples[0])[2::3]).max() == 0
    upright = ball_chain_pose(np.array([[0, 0, 1.0], [0, 0, 1.0]]), np.stack([np.eye(3)] * 2))
    np.testing.assert_allclose(upright, [0, -np.pi / 2, 0, 0, 0, 0], atol=1e-9)


def test_other_units_and_axes(samples):
    y_up_mm = [Sample(s.time, {n: 1000 * p[[1, 2, 0]] for n, p in s.points.items()}) for s in samples]
    expected = LiveArm(find_arms(live_body(samples[0])), "left", 1.0, "z", 0.0, (0.0, 0.0, 0.0)).motion(samples)
    arm = LiveArm(find_arms(live_body(y_up_mm[0], "mm", up="y")), "left", 0.001, "y", 0.0, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(arm.motion(y_up_mm).end, expected.end, atol=1e-9)
    with pytest.raises(ValueError, match="expected metres, got arms 530, 530 long, as an adult's in mm; capture.unit="):
        live_body(y_up_mm[0], "", up="y")
    with pytest.raises(ValueError, match="points: expected z up, got y from the feet to the head; capture.up="):
        live_body(y_up_mm[0], "mm")


def test_points_without_an_arm(samples):
    with pytest.raises(ValueError, match="points: no arm was found .* of nose, a"):
        live_body(Sample(0.0, {"nose": np.zeros(3), "a": np.zeros(3)}), "")
    with pytest.raises(ValueError, match="of none"):
        live_body(Sample(0.0, {}), "")


def test_the_points_of_one_of_two_people(samples):
    points = {f"{who}_{name}": point for who in ("Ann", "Bob") for name, point in samples[0].points.items()}
    arms = find_arms(live_body(Sample(0.0, points), subject="bob"))
    assert arms["right"].shoulder == ("Bob_RightArm",)


def test_link_lengths_are_checked_in_each_sample(arm, samples):
    measured = dataclasses.replace(arm, lengths=arm.motion(samples[:3]).link_lengths)
    measured.pose(samples[9])
    points = dict(samples[9].points)
    points["RightHand"] = 2 * points["RightHand"] - points["RightForeArm"]
    with pytest.raises(ValueError, match="expected link lengths as in the first samples"):
        measured.pose(Sample(0.0, points))


def test_points_that_are_not_seen_or_coincide(arm, samples):
    points = dict(samples[0].points)
    assert arm.has_all(samples[0])
    assert not arm.has_all(Sample(0.0, {**points, "RightHand": np.full(3, np.nan)}))
    assert not arm.has_all(Sample(0.0, {name: point for name, point in points.items() if name != "LeftArm"}))
    assert arm.has_all(Sample(0.0, {name: point for name, point in points.items() if name != "LeftHand"}))
    with pytest.raises(ValueError, match="apart"):
        arm.pose(Sample(0.0, {**points, "RightHand": points["RightForeArm"]}))


def test_a_body_is_not_needed(samples):
    """The points of the arm alone suffice; forward is then the x-axis of the points."""
    points = {name: samples[0].points[name] for name in ("RightArm", "RightForeArm", "RightHand")}
    arms = find_arms(live_body(Sample(0.0, points)))
    assert set(arms) == {"right"}
    links = LiveArm(arms, "right", 1.0, "z", 0.0, (0.0, 0.0, 0.0)).motion([Sample(0.0, points)])
    np.testing.assert_allclose(links.end[0, 0], points["RightForeArm"] - points["RightArm"], atol=1e-12)
    assert isinstance(person(2), PointMotion)
