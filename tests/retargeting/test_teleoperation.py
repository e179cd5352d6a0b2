"""A leader that drives a follower: within limits whatever arrives, without jumps, and at the leader's hand."""

import dataclasses

import jax
import numpy as np
import pytest

import mimic
from mimic.control.clearance import clearance
from mimic.metric.capsule_distances import clearance_constants
from mimic.retargeting.follower_limits import follower_limits
from mimic.retargeting.hand_target import matched_hands
from mimic.retargeting.live_pose import FAR, ArmRows, LivePose
from mimic.retargeting.self_contacts import APART, SelfContacts
from tests.helpers import original_model

RATE = 100.0
READY = np.array([0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4])
SWAY = np.array([0.3, 0.2, 0.3, 0.2, 0.3, 0.2, 0.3])


@pytest.fixture(scope="module")
def arms():
    leader = mimic.panda(limits="hardware")
    # Other lengths, and without joint 3: six joints.
    return leader, mimic.panda(limits="hardware", locked=[3])


def sway(ticks, speed=1.0):
    return READY + np.sin(speed * np.arange(ticks) / RATE)[:, None] * SWAY


def drive(operator, samples, **arguments):
    """The commands of samples, and the limits that they exceed."""
    commands = [operator.step(sample, **arguments) for sample in samples]
    return commands, np.array([command.qpos for command in commands])


def excess(operator, path):
    """Maximum of speed, acceleration and jerk over their limits, and of the angle beyond its range [rad]."""
    limits, ratios = operator.limits, []
    differences = path
    for limit in (limits.velocity, limits.acceleration, limits.jerk):
        differences = np.diff(differences, axis=0) * RATE
        ratios.append(np.max(np.abs(differences) / limit))
    lower, upper = limits.position.T
    return max(ratios), np.max(np.maximum(lower - path, path - upper))


def assert_within_limits(operator, path):
    assert np.all(np.isfinite(path))
    ratio, beyond = excess(operator, path)
    assert ratio <= 1 + 1e-6 and beyond <= 1e-9  # differences of the limiter's rounding


def test_rows_are_the_kinematics_and_their_derivatives(arms):
    arm, step = arms[1], 1e-6
    rows, qpos = ArmRows(arm), np.random.default_rng(0).uniform(-1, 1, (3, arm.num_joints))
    frames, table = mimic.hand_frames(arm, qpos), rows(qpos)
    hand = table[:, rows.hand_rows(np.array([0]))]
    np.testing.assert_allclose(rows.unit * hand[:, :1], frames.position, atol=1e-6)  # of single precision
    np.testing.assert_allclose(np.swapaxes(hand[:, None, 1:], 2, 3), frames.rotation, atol=1e-6)
    states = mimic.link_states(arm, qpos)
    np.testing.assert_allclose(table[:, rows.points], states.position, atol=1e-6)
    np.testing.assert_allclose(table[:, rows.directions], states.direction, atol=1e-6)
    columns = rows.jacobian(table)
    for joint in range(arm.num_joints):
        change = step * np.eye(arm.num_joints)[joint]
        numeric = (rows(qpos + change) - rows(qpos - change))[:, rows.moving] / (2 * step)
        np.testing.assert_allclose(columns[:, joint], numeric, atol=1e-8)


def test_posture_is_that_of_imitate_pose(arms):
    metric = mimic.metric.config.MetricConfig().build(*arms)
    expected = mimic.imitate_pose(*arms, READY + SWAY, **metric.arguments, hand="exact")
    leader, follower = (ArmRows(arm) for arm in arms)
    pairs = matched_hands(*arms)
    pose = LivePose(leader, follower, pairs, metric)
    of_leader = leader(READY[None] + SWAY)[0]
    hands = of_leader[leader.hand_rows(pairs[:, 0])]
    hands[: len(pairs)] *= leader.unit / follower.unit
    goal = pose.goal(of_leader, hands)
    lower, upper = arms[1].joint_range.T
    qpos = np.random.default_rng(0).uniform(lower, upper, (24, 6))
    for _ in range(40):
        qpos = pose.step(goal, qpos, np.maximum(lower, qpos - 0.5), np.minimum(upper, qpos + 0.5), FAR)
    cost = pose.cost(goal, follower(qpos))
    np.testing.assert_allclose(qpos[cost.argmin()], expected.qpos, atol=2e-3)


def test_a_step_is_the_best_in_its_box(arms):
    """Also where many joints are at an edge: a step that only cuts off what is beyond goes to and fro there."""
    rng, rows = np.random.default_rng(0), [ArmRows(arm) for arm in arms]
    pose = LivePose(*rows, matched_hands(*arms), mimic.metric.config.MetricConfig().build(*arms))
    columns, gradient = rng.normal(size=(200, 3, 6)), 0.03 * rng.normal(size=(200, 6))
    hessian = columns.swapaxes(1, 2) @ columns + 1e-5 * np.eye(6)  # as of a hand: three directions, and damping
    lower, upper = -rng.choice([0.0, 0.02], (200, 6)), rng.choice([0.0, 0.02], (200, 6))
    step = pose._step_in_box(hessian, gradient, lower, upper)
    slope = (hessian @ step[..., None])[..., 0] + gradient
    assert np.all((step >= lower) & (step <= upper + 1e-11))  # a box has a width
    rises, falls = slope > -1e-9, slope < 1e-9  # of double precision
    assert np.all((rises | (step >= upper)) & (falls | (step <= lower)))


def test_hand_is_reached(arms):
    operator = mimic.Teleoperator(*arms, hand="exact", rate=RATE)
    operator.engage()
    commands, path = drive(operator, [*sway(400, speed=0.5), *np.repeat(sway(400, speed=0.5)[-1:], 50, axis=0)])
    status = commands[-1].status
    assert status.state == "tracking" and status.position_mm < 0.1 and status.rotation_deg < 0.1
    assert_within_limits(operator, path)


def test_clutch_engages_anywhere_without_a_jump(arms):
    operator = mimic.Teleoperator(*arms, hand="relative", scale=0.5, rate=RATE)
    start = operator.step(None).qpos
    operator.engage()
    np.testing.assert_allclose(operator.step(READY + 0.8 * SWAY).qpos, start, atol=1e-4)
    drive(operator, READY + 0.8 * SWAY + np.linspace(0, 1, 100)[:, None] * SWAY)
    operator.disengage()
    _, path = drive(operator, [READY] * 50)
    assert_within_limits(operator, path)
    operator.engage()
    _, after = drive(operator, [READY - SWAY] * 20)
    np.testing.assert_allclose(after, np.tile(path[-1], (20, 1)), atol=1e-3)


def test_relative_hand_moves_by_the_scaled_motion(arms):
    operator = mimic.Teleoperator(*arms, hand="relative", scale=0.5, base=[0, 0, 0, np.pi / 2], rate=RATE)
    before = mimic.hand_frames(arms[1], operator.step(None).qpos).position[0]
    operator.engage()
    target = READY + np.array([0.0, 0.2, 0.0, 0.2, 0.0, 0.0, 0.0])
    _, path = drive(operator, [*np.linspace(READY, target, 100), *[target] * 100])
    ends = [mimic.hand_frames(arms[0], x).position[0] for x in (READY, target)]
    moved = mimic.hand_frames(arms[1], path[-1]).position[0] - before
    x, y, z = 0.5 * (ends[1] - ends[0])
    np.testing.assert_allclose(moved, [y, -x, z], atol=2e-4)  # the base is rotated by 90 deg


def test_mirror_reflects_the_hand(arms):
    operator = mimic.Teleoperator(arms[0], arms[0], mirror=True, rate=RATE)
    operator.engage()
    pose = READY + np.array([0.4, 0.1, 0.2, 0.1, -0.2, 0.0, 0.3])
    commands, path = drive(operator, [pose] * 600)
    assert commands[-1].status.state == "tracking"
    leader, follower = (jax.device_get(mimic.hand_frames(arms[0], x)) for x in (pose, path[-1]))
    np.testing.assert_allclose(follower.position[0], leader.position[0] * [1, -1, 1], atol=1e-3)
    approach = leader.rotation[0, :, 2] * np.array([1, -1, 1])
    np.testing.assert_allclose(follower.rotation[0, :, 2], approach, atol=1e-2)


BAD = {
    "not finite": lambda n, s: np.where(n % 2, np.nan, s),
    "jumped": lambda n, s: s + 2 * (n % 3 == 1),
    "no sample": lambda n, s: None,
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_samples_hold_and_recover(arms, kind):
    operator = mimic.Teleoperator(*arms, hand="relative", rate=RATE)
    operator.engage()
    good = sway(400)
    samples = [*good[:100], *(BAD[kind](n, good[100 + n]) for n in range(100)), *good[200:]]
    commands, path = drive(operator, samples)
    assert_within_limits(operator, path)
    reasons = " ".join(command.status.reason for command in commands[100:200])
    assert kind in reasons and all(np.isfinite(command.status.position_mm) for command in commands)
    assert all(command.status.state in ("tracking", "catching up") for command in commands[250:])


def test_time_that_runs_backwards_is_ignored_then_accepted(arms):
    operator = mimic.Teleoperator(*arms, hand="relative", rate=RATE)
    operator.engage()
    path, commands = sway(200), []
    times = np.arange(200) / RATE - 50 * (np.arange(200) >= 100)  # the clock is set back
    times[40] = times[30]
    for sample, time in zip(path, times, strict=True):
        commands.append(operator.step(sample, time=float(time)))
    assert "newer" in commands[40].status.reason and "newer" not in commands[41].status.reason
    assert "newer" in commands[100].status.reason and commands[130].status.state != "holding"
    assert_within_limits(operator, np.array([command.qpos for command in commands]))


def test_a_sample_that_is_repeated_is_none(arms):
    """A driver that has died may send its last sample, with its stamp, for ever."""
    operator = mimic.Teleoperator(*arms, hand="relative", rate=RATE)
    operator.engage()
    commands = [operator.step(sample, time=n / RATE) for n, sample in enumerate(sway(50))]
    commands += [operator.step(READY, time=49 / RATE) for _ in range(40)]
    assert commands[49].status.state != "holding" and commands[-1].status.state == "holding"


def test_a_buffer_may_be_used_again(arms):
    operator = mimic.Teleoperator(*arms, hand="relative", rate=RATE)
    operator.engage()
    buffer = READY.copy()
    operator.step(buffer)
    buffer += 2.0
    assert "jump" in operator.step(buffer).status.reason


def test_hand_out_of_reach_ends_at_the_nearest(arms):
    operator = mimic.Teleoperator(*arms, base=[-1.0, 0, 0, 0], rate=RATE)  # the hand is 1.3 m away
    operator.engage()
    commands, path = drive(operator, [READY] * 800)
    status = commands[-1].status
    assert status.state == "nearest" and "mm" in status.reason and status.position_mm > 100
    assert_within_limits(operator, path)
    assert np.abs(np.diff(path[-50:], axis=0)).max() < 1e-4  # at rest
    lower, upper = arms[1].joint_range.T
    poses = np.random.default_rng(0).uniform(lower, upper, (20000, 6))
    hands = np.asarray(mimic.hand_frames(arms[1], poses.astype(np.float32)).position)[:, 0]
    goal = np.asarray(mimic.hand_frames(arms[0], READY).position)[0] + [1.0, 0, 0]
    assert status.position_mm <= 1e3 * np.linalg.norm(hands - goal, axis=1).min() + 1


def test_an_approach_ends_while_the_leader_moves_faster(arms):
    """The leader goes round at almost the follower's speed; an approach at half of it would never arrive."""
    operator = mimic.Teleoperator(*arms, rate=RATE, velocity=1.0)
    operator.engage()
    phase = 1.8 * np.arange(1000) / RATE
    samples = np.tile(READY, (1000, 1))
    samples[:, 0] += 0.5 * np.sin(phase)
    samples[:, 3] += 0.5 * np.cos(phase)
    commands, path = drive(operator, samples)
    assert_within_limits(operator, path)
    states = [command.status.state for command in commands]
    assert states[50] == "approaching" and "approaching" not in states[600:]
    assert max(command.status.position_mm for command in commands[900:]) < 120


def test_a_leader_that_is_too_fast_is_not_said_to_be_out_of_reach(arms):
    operator = mimic.Teleoperator(arms[0], arms[0], hand="relative", rate=RATE, velocity=0.2)
    operator.reset(READY)
    operator.engage()
    commands, _ = drive(operator, sway(150))
    states = [command.status.state for command in commands]
    assert set(states[10:100]) == {"catching up"} and commands[90].status.position_mm > 20
    assert "faster than the limits" in commands[90].status.reason


def test_the_first_approach_is_slow(arms):
    operator = mimic.Teleoperator(*arms, rate=RATE)
    operator.engage()
    _, path = drive(operator, [READY + 2 * SWAY] * 300)
    assert np.max(np.abs(np.diff(path, axis=0)) * RATE / operator.limits.velocity) <= 0.51


def test_a_sample_that_jumps_is_told_where_the_hand_is_out_of_reach(arms):
    operator = mimic.Teleoperator(*arms, hand="relative", scale=3.0, rate=RATE)
    operator.reset(operator.qpos)
    operator.engage()
    for x in [*np.linspace(0, 1, 100), *np.ones(100)]:
        operator.step(READY + x * np.array([0.0, 1.5, 0.0, 2.5, 0.0, 0.0, 0.0]))
    status = operator.step(READY - 1.5).status
    assert status.state == "nearest" and "jumped" in status.reason and "nearest hand is" in status.reason


def test_gripper_is_mapped_at_a_limited_speed(arms):
    operator = mimic.Teleoperator(*arms, hand="relative", rate=RATE, grippers=((10, 60), (0.0, 0.08)))
    operator.engage()
    assert operator.step(READY).gripper is None
    assert operator.step(READY, gripper=35).gripper == pytest.approx(0.04)
    openings = [operator.step(READY, gripper=200 if n < 30 else np.nan).gripper for n in range(40)]
    assert openings[-1] == pytest.approx(0.08)
    assert np.max(np.diff(openings)) <= 0.08 / 25 + 1e-9


def test_arguments_are_checked(arms):
    bare = dataclasses.replace(arms[1], velocity_limit=np.full(6, np.inf))
    with pytest.raises(ValueError, match=r"velocity: expected 6 maximum speeds.*states none"):
        mimic.Teleoperator(arms[0], bare)
    assert np.all(follower_limits(bare, 2.0).velocity == 2)
    for arguments, match in (({"rate": 0}, "rate"), ({"scale": np.nan}, "scale"), ({"hand": "near"}, "hand")):
        with pytest.raises(ValueError, match=match):
            mimic.Teleoperator(*arms, **arguments)
    operator = mimic.Teleoperator(*arms)
    with pytest.raises(ValueError, match="expected 6 angles within the follower's limits"):
        operator.reset([9.0] * 6)
    with pytest.raises(ValueError, match=r"leader_qpos: expected 7 angles"):
        operator.step([0.0] * 6)


def test_flipped_wrists_keep_the_rotation_of_the_hand(arms, tmp_path):
    file = original_model.ur_file(tmp_path)
    arm = mimic.build_arm(mimic.ArmConfig(model=str(file)), "hardware").embodiment
    search, rows = mimic.Teleoperator(arms[0], arm, velocity=3.0)._live._branches, ArmRows(arm)
    flipped = search._flipped(np.array([0.3, -1.2, 1.4, -1.0, -1.2, 0.2]))
    assert len(flipped) > 1 and np.all(np.abs(np.diff(flipped, axis=0)).max(axis=1) > 1)
    axes = rows(flipped)[:, rows.hand_rows(np.array([0]))[1:]]
    np.testing.assert_allclose(axes, np.tile(axes[:1], (len(axes), 1, 1)), atol=1e-9)


@pytest.fixture(scope="module")
def capsules():
    return mimic.fit_capsules(mimic.ArmConfig(), "hardware")


def test_distances_of_links_are_those_of_the_safety_layer(arms, capsules):
    """MuJoCo's distances, and their gradients, beside NumPy's of the safety layer."""
    panda, contacts = arms[0], SelfContacts(arms[0], capsules)
    constants = clearance_constants(panda, capsules, floor_height=-10.0)
    apart, differences, gradients = APART * float(panda.chain_length), [], []
    for qpos in np.random.default_rng(0).uniform(*panda.joint_range.T, (300, 7)):
        near, smallest = contacts.near(qpos), float(clearance(qpos, constants))
        if near is None:
            assert smallest > 0.05
            continue
        np.testing.assert_allclose(near.room.min() + apart, smallest, atol=1e-5)  # of single precision
        if smallest > 0.005:  # where axes cross, the distance has a kink
            changes = clearance(qpos + 1e-3 * np.concatenate([np.eye(7), -np.eye(7)]), constants)
            differences.append((changes[:7] - changes[7:]) / 2e-3)
            gradients.append(near.gradient[near.room.argmin()])
    # At a few poses another pair is the nearest within the difference.
    assert len(gradients) > 20 and np.median(np.abs(np.subtract(gradients, differences)).max(axis=1)) < 2e-3


def test_a_hand_that_is_led_into_the_arm_stops_before(arms, capsules):
    """A pose of a hand leads, which needs no arm; the safety layer's distance of links is the judge."""
    panda = arms[0]
    operator = mimic.Teleoperator(None, panda, rate=RATE, capsules=capsules)
    operator.engage()
    pose = np.eye(4)
    pose[:3, :3], begin = np.diag([1.0, -1.0, -1.0]), np.array([0.45, 0.1, 0.4])
    samples = np.tile(pose, (400, 1, 1))
    samples[:, :3, 3] = begin + np.linspace(0, 1, 400)[:, None] * ([0.0, 0.0, 0.25] - begin)
    commands, path = drive(
        operator, [*np.tile(samples[:1], (300, 1, 1)), *samples, *np.tile(samples[-1:], (600, 1, 1))]
    )
    assert_within_limits(operator, path)
    assert commands[300].status.state == "tracking"
    smallest = clearance(path, clearance_constants(panda, capsules, floor_height=-10.0)).min()
    assert smallest > 0.9 * APART * float(panda.chain_length) and "would touch" in commands[-1].status.reason
    assert commands[-1].status.state == "nearest"
    assert np.abs(np.diff(path[-20:], axis=0)).max() < 2e-3  # it may slide


def test_a_hand_leads_as_an_arm_does(arms):
    """Relative poses move the follower's hand as far, whatever the headset's axes; bad ones are ignored."""
    operator = mimic.Teleoperator(None, arms[0], hand="relative", rate=RATE)
    start = mimic.hand_frames(arms[0], operator.qpos)
    operator.engage()
    pose = np.eye(4)
    samples = [pose + [[0, 0, 0, x], [0, 0, 0, -x], [0] * 4, [0] * 4] for x in np.linspace(0, 0.1, 100)]
    bad = [np.full((4, 4), np.nan), 2 * pose, pose + 3 * np.eye(4)[3], samples[-1] * [[1, 1, 1, 30]]]
    commands, path = drive(operator, [*samples, *[samples[-1]] * 100, *bad])
    assert_within_limits(operator, path)
    moved = mimic.hand_frames(arms[0], path[-1])
    np.testing.assert_allclose(moved.position - start.position, [[0.1, -0.1, 0]], atol=2e-4)
    np.testing.assert_allclose(moved.rotation, start.rotation, atol=2e-3)
    assert commands[199].status.state == "tracking"
    assert ["not finite, or no rotation" in x.status.reason for x in commands[-4:]] == [True, True, False, False]
    assert all("jumped" in x.status.reason for x in commands[-2:])
    assert commands[-1].status.position_mm < 1
    with pytest.raises(ValueError, match=r"expected 1 poses \[4, 4\]"):
        operator.step(np.zeros(7))


def test_the_branch_that_can_follow_is_taken():
    """Of two elbows with the same hand, the nearer to the leader's soon ends at a limit."""
    lengths, pose = (0.4, 0.4, 0.2), np.array([-0.4, 0.9, 0.0])
    leader, follower = (
        dataclasses.replace(mimic.planar_arm(lengths), velocity_limit=np.full(3, 2.0), home=np.zeros(3)) for _ in "ab"
    )
    ranges = np.array([[-2.5, 2.5], [-2.5, 1.0], [-2.5, 2.5]])  # 0.1 rad from the leader's elbow
    follower = dataclasses.replace(follower, joint_range=ranges)
    operator = mimic.Teleoperator(leader, follower, rate=RATE)
    operator.engage()
    drive(operator, [pose] * 500)
    assert operator.qpos[1] < -0.5
    elbow = np.linspace(0.9, 1.8, 300)[:, None]
    commands, _ = drive(operator, [*(pose * [1, 0, 1] + elbow * [0, 1, 0]), *[[-0.4, 1.8, 0.0]] * 50])
    assert {command.status.state for command in commands} <= {"tracking", "catching up"}
