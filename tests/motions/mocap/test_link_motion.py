"""Link states of captured links: against closed forms, and against the arm with ball joints."""

import dataclasses

import numpy as np
import pytest

import mimic
from mimic.metric.kinematics import link_state_table
from mimic.motions.mocap.ball_chain import ball_chain_motion, ball_chain_xml, zero_frames
from mimic.motions.mocap.clips import relative_speeds, slow_down_for, slow_down_for_windows, turned, windows
from mimic.motions.mocap.link_motion import LinkMotion, arm_motion, low_pass, motion_states, rigid_error
from mimic.motions.mocap.points import bridge_gaps, gaps, jumps
from tests.helpers.bodies import RATE, person

FIELDS = ("position", "direction", "linear_velocity", "angular_velocity")


@pytest.fixture(scope="module")
def body():
    return person(600)


@pytest.fixture(scope="module")
def right_arm(body):
    return arm_motion(body, "right", name="right_arm")


def circling(rate=500.0, speed=3.0):
    """Two links of 0.3 and 0.2 m; the first turns about z, the second about z in the other direction."""
    time = np.arange(0, 2, 1 / rate)
    first = np.stack([np.cos(speed * time), np.sin(speed * time), 0 * time], axis=1)
    second = np.stack([np.cos(2 * speed * time), -np.sin(2 * speed * time), 0 * time], axis=1)
    elbow = 0.3 * first
    start = np.stack([0 * elbow, elbow], axis=1)
    return time, LinkMotion(("a", "b"), (-1, 0), start, np.stack([elbow, elbow + 0.2 * second], axis=1), rate)


def test_states_of_circling_links():
    time, motion = circling()
    states = motion_states(motion, cutoff=np.inf)
    inner = slice(2, -2)
    assert states.angular_velocity is not None
    np.testing.assert_allclose(states.angular_velocity[inner, 0], np.tile([0, 0, 3.0], (len(time) - 4, 1)), atol=1e-3)
    np.testing.assert_allclose(states.angular_velocity[inner, 1], np.tile([0, 0, -6.0], (len(time) - 4, 1)), atol=1e-3)
    middle = 0.15 * 3.0 * np.stack([-np.sin(3 * time), np.cos(3 * time), 0 * time], axis=1) / 0.5
    np.testing.assert_allclose(states.linear_velocity[inner, 0], middle[inner], atol=1e-3)
    np.testing.assert_allclose(states.position[:, 1], 0.5 * (motion.start + motion.end)[:, 1] / 0.5, atol=1e-12)


def test_the_filter_halves_amplitudes_at_its_cutoff_and_delays_nothing():
    time = np.arange(0, 20, 0.01)
    for frequency, gain in ((6.0, 0.5), (0.5, 1.0), (40.0, 0.0)):
        wave = np.sin(2 * np.pi * frequency * time)
        filtered = low_pass(wave, 100.0, 6.0)[500:-500]
        assert filtered @ wave[500:-500] / (wave[500:-500] @ wave[500:-500]) == pytest.approx(gain, abs=0.01)


def test_arms_are_seen_from_the_shoulder(right_arm):
    assert right_arm.names == ("upper_arm", "forearm", "hand")
    np.testing.assert_allclose(right_arm.link_lengths, [0.28, 0.25, 0.09], atol=1e-9)
    np.testing.assert_array_equal(right_arm.start[:, 0], 0)
    assert right_arm.chain_length == pytest.approx(0.62)
    assert rigid_error(right_arm, cutoff=np.inf) < 1e-12


def test_the_base_frame_turns_with_the_body(body, right_arm):
    """A person who turns around and walks does not move the arm in its own frame."""
    time = np.arange(600) / RATE
    angle = 0.8 * np.sin(0.5 * time)
    cosine, sine, zero, one = np.cos(angle), np.sin(angle), 0 * angle, 1 + 0 * angle
    rotation = np.stack(
        [np.stack(row, 1) for row in ((cosine, -sine, zero), (sine, cosine, zero), (zero, zero, one))], 1
    )
    walking = np.einsum("tij,tpj->tpi", rotation, body.positions) + 0.3 * time[:, None, None]
    moved = arm_motion(dataclasses.replace(body, positions=walking), "right")
    inner = slice(60, -60)  # the filter of the facing direction has no past at the ends
    np.testing.assert_allclose(moved.end[inner], right_arm.end[inner], atol=1e-3)
    np.testing.assert_allclose(right_arm.end[:, -1, 2], (body.point("RightHandMiddle1") - body.point("RightArm"))[:, 2])


def test_forward_is_x_and_left_is_y(body):
    """The person of the files faces z there, which is x after reading; the left arm at rest points left."""
    left = arm_motion(dataclasses.replace(body, positions=np.repeat(body.positions[:1], 30, axis=0)), "left")
    shoulders = body.point("LeftArm")[0] - body.point("RightArm")[0]
    np.testing.assert_allclose(shoulders / np.linalg.norm(shoulders), [0, 1, 0], atol=1e-9)
    world = body.point("LeftHand")[0] - body.point("LeftArm")[0]
    np.testing.assert_allclose(left.end[0, 1], world, atol=1e-9)


def test_both_arms_are_seen_from_the_middle_between_the_shoulders(body):
    motion = arm_motion(body, "both", trunk=0.2)
    links = ("trunk", "upper_arm", "forearm", "hand")
    assert motion.names == tuple(f"{side}_{link}" for side in ("left", "right") for link in links)
    assert motion.parents == (-1, 0, 1, 2, -1, 4, 5, 6)
    np.testing.assert_allclose(motion.base_points[[0, 4]], [[0, 0.18, 0], [0, -0.18, 0]], atol=1e-6)
    assert motion.chain_length == pytest.approx(0.2 + 0.62)  # of one arm
    for side, links in (("left", slice(0, 4)), ("right", slice(4, 8))):
        alone = motion_states(arm_motion(body, side, trunk=0.2), normalized=False)
        both = motion_states(motion, normalized=False)
        np.testing.assert_allclose(both.position[:, links] - motion.base_points[links], alone.position, atol=1e-6)
        velocities = np.asarray(both.angular_velocity)[:, links]
        np.testing.assert_allclose(velocities, np.asarray(alone.angular_velocity), atol=1e-9)


@pytest.mark.parametrize(("side", "trunk"), [("left", 0.0), ("left", 0.25), ("both", 0.25)])
def test_the_arm_with_ball_joints_has_the_same_states(body, side, trunk, tmp_path):
    motion = turned(arm_motion(body, side, trunk=trunk), 0.3, 0.2, -0.1)
    zero = zero_frames(motion)
    (tmp_path / "arm.xml").write_text(ball_chain_xml(motion, zero))
    arm = mimic.load_mjcf(tmp_path / "arm.xml", tip=["*"])
    assert len(arm.chains) == (2 if side == "both" else 1)
    assert arm.num_links == motion.num_links and arm.num_joints == 3 * motion.num_links
    qpos, qvel = ball_chain_motion(motion, zero)
    states, table = motion_states(motion), link_state_table(arm, qpos, qvel)
    for field in FIELDS:
        np.testing.assert_allclose(getattr(table, field), getattr(states, field), atol=2e-6)
    assert np.abs(np.diff(qpos, axis=0)).max() < 0.5  # no jumps of a full turn


def test_windows_do_not_cross_from_training_to_held_out(right_arm):
    zero = zero_frames(right_arm)
    cut = windows([right_arm], zero, starts=[0.0], dt=0.1, horizon=10, slow_down=2.0, overlap=0.5, held_out=0.25)
    length = 10 * 0.1 / 2.0
    assert cut.training + cut.held_out == cut.demonstrations.count == len(cut.start)
    assert cut.start[: cut.training].max() + length <= cut.start[cut.training :].min() + 1e-9
    states = motion_states(right_arm)
    first = int(round(cut.start[3] * RATE))
    arm_states = ball_chain_motion(right_arm, zero)[1][first] / 2.0
    np.testing.assert_allclose(cut.demonstrations.qvel[3, 0], arm_states, atol=0.05)  # half as fast
    assert len(states.position) == 600
    assert slow_down_for([right_arm], 1.0) == pytest.approx(np.quantile(relative_speeds(right_arm).max(axis=1), 0.995))
    with pytest.raises(ValueError, match="expected a motion without gaps of"):
        windows([right_arm.cut(0, 40)], zero, starts=[0.0], dt=0.1, horizon=50)


def test_a_short_motion_is_slowed_down_until_two_windows_fit(right_arm):
    seconds = 0.7
    short = right_arm.cut(0, int(seconds * RATE) + 1)
    slow_down = slow_down_for_windows([short], 5.0)
    assert slow_down == pytest.approx(10 / seconds)
    cut = windows([short], zero_frames(short), starts=[0.0], dt=0.1, horizon=50, slow_down=slow_down)
    assert (cut.training, cut.held_out) == (1, 1)
    assert slow_down_for_windows([short, short], 5.0) == pytest.approx(5 / seconds)  # one in each
    assert slow_down_for_windows([short.cut(0, 2)], 5.0) == np.inf


def test_short_gaps_are_bridged_and_long_ones_split(body):
    positions = body.positions.copy()
    positions[100:112, 11] = np.nan  # 0.2 s at 60 Hz
    positions[300:313, 12] = np.nan
    motion = dataclasses.replace(body, positions=positions)
    assert gaps(motion) == [(100, 12), (300, 13)]
    parts, bridged = bridge_gaps(motion)
    assert bridged == 1 and [len(part.positions) for part in parts] == [300, 287]
    assert [part.begin for part in parts] == pytest.approx([0.0, 313 / RATE])
    assert parts[1].cut(60, 80).begin == pytest.approx(373 / RATE)
    np.testing.assert_allclose(parts[0].positions[100:112, 11], body.positions[100:112, 11], atol=0.02)


def test_jumps_and_a_first_frame_in_another_pose_are_found(body):
    """At 30 Hz 0.4 m in one sample are slower than a hand can be, but no hand is as fast in that sample alone."""
    positions = body.positions.copy()
    positions[200:, 6] += 0.5
    assert jumps(dataclasses.replace(body, positions=positions)).tolist() == [200] and len(jumps(body)) == 0
    slow = dataclasses.replace(body, positions=body.positions[::2].copy(), rate=RATE / 2)
    assert len(jumps(slow)) == 0
    slow.positions[0] += [0.0, 0.0, 0.4]
    assert jumps(slow).tolist() == [1]


def test_what_is_no_motion_is_rejected(right_arm):
    with pytest.raises(ValueError, match="expected finite positions"):
        dataclasses.replace(right_arm, end=right_arm.end * np.nan)
    with pytest.raises(ValueError, match="expected lengths above"):
        dataclasses.replace(right_arm, end=right_arm.start)
    with pytest.raises(ValueError, match="expected an earlier link"):
        dataclasses.replace(right_arm, parents=(-1, 1, 0))
