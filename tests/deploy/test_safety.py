"""The safety layer: what it rejects, why it stops, and that a checked braking path is always left."""

import dataclasses
import re

import numpy as np
import pytest

from mimic.deploy import safety
from mimic.deploy.config import SafetyConfig
from mimic.deploy.safety import COLLISION, INVALID, LATE, REPEATED, SafetyLayer, check_supported
from tests.helpers import bundles

CONFIG = SafetyConfig()
TICK, LATENCY = 5, 2  # steps of 10 ms


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return bundles.make_bundle(tmp_path_factory.mktemp("bundles") / "bundle")


def started(bundle, clearance=None, config=CONFIG, robots=1, pose=None):
    """A layer of arms at rest in their start pose."""
    layer = SafetyLayer(bundle, robots, config, clearance)
    qpos = np.tile((bundle.start_pose if pose is None else pose)[:, None], robots)
    assert set(layer.start(qpos, 0 * qpos, qpos)) == {""}
    return layer


@pytest.fixture
def layer(bundle):
    return started(bundle)


def run(layer, action, ticks=1, present=True):
    """Ticks with an action on an arm that follows its reference exactly; angles and velocities after each step."""
    paths = []
    for _ in range(ticks):
        reference = layer.reference
        command = layer.tick(reference.qpos, reference.qvel, np.asarray(action, float)[:, None], np.array([present]))
        paths.append(np.stack(command.path, axis=1)[..., 0])
    return np.concatenate(paths)


def velocity(joint, value):
    return np.where(np.arange(7) == joint, value, 0.0)


def test_an_accepted_target_moves_the_arm(layer):
    qpos, qvel, _ = run(layer, velocity(0, 0.5), ticks=20).transpose(1, 0, 2)
    assert qvel[-1, 0] == pytest.approx(0.5 * bundles.parameters().velocity[0], rel=1e-3)
    assert np.all(np.diff(qpos[:, 0]) > 0) and qvel[0, 0] > 0 and np.ptp(qpos[:, 1:], axis=0).max() == 0
    assert not any(count[0] for count in layer.counts.values())


def test_the_reference_of_a_tick_is_a_latency_before_the_end_of_the_last_command(layer):
    before = run(layer, velocity(0, 0.5), ticks=3)
    np.testing.assert_array_equal(layer.reference.qpos[:, 0], before[-1 - LATENCY, 0])
    np.testing.assert_array_equal(layer.reference.qvel[:, 0], before[-1 - LATENCY, 1])
    after = run(layer, velocity(0, 0.5))
    assert after[0, 0, 0] - before[-1, 0, 0] == pytest.approx(0.01 * after[0, 1, 0], rel=0.05)  # it goes on there


def test_the_stop_is_the_end_of_the_braking_path(layer, bundle):
    command = layer.tick(bundle.start_pose[:, None], np.zeros((7, 1)), velocity(0, 1.0)[:, None])
    assert command.stop[0, 0] > command.qpos[0, 0] + 1e-3
    assert command.qpos is command.path.qpos[-1] or np.array_equal(command.qpos, command.path.qpos[-1])
    for _ in range(layer.brake_ticks):
        last = layer.tick(layer.reference.qpos, layer.reference.qvel, None)
    np.testing.assert_array_equal(last.qpos, command.stop)
    assert np.all(last.qvel == 0) and not any(count[0] for count in layer.counts.values())


def test_the_whole_path_is_checked(bundle):
    """From the first sample of the tick to the last one of braking."""
    checked = []

    def clearance(rows):
        checked.append(rows)
        return np.ones(len(rows))

    layer = started(bundle, clearance)
    command = layer.tick(bundle.start_pose[:, None], np.zeros((7, 1)), velocity(0, 1.0)[:, None])
    path = checked[-1]
    np.testing.assert_array_equal(path[0], bundle.start_pose)
    np.testing.assert_array_equal(path[1 : TICK + 1], command.path.qpos[..., 0])
    np.testing.assert_array_equal(path[-1], command.stop[:, 0])
    assert len(path) > 1 + TICK + 10 and np.abs(np.diff(path[:, 0])).max() < 0.01


@pytest.mark.parametrize("sample", [1, TICK, TICK + 1, -1])
@pytest.mark.parametrize("value", [np.nan, CONFIG.margin - 1e-6])
def test_a_path_with_one_sample_too_near_or_unknown_is_rejected(bundle, sample, value):
    def clearance(rows):
        result = np.ones(len(rows))
        if len(rows) > 1:
            result[sample] = value
        return result

    layer = started(bundle, clearance)
    path = run(layer, velocity(0, 0.5))
    assert layer.counts[COLLISION][0] == 1 and np.all(path[:, 1] == 0)


@pytest.mark.parametrize(
    ("at_first", "later", "is_taken"),
    [
        (1.0, 0.02, True),  # the margin
        (1.0, 0.0199, False),
        (0.018, 0.018, True),  # from within the margin: no nearer
        (0.018, 0.0179, False),
        (0.018, 0.05, True),
        (0.012, 0.0151, True),  # the floor, margin - creep, counts where the path begins below it
        (0.012, 0.0149, False),
    ],
)
def test_the_clearance_that_a_path_needs(bundle, at_first, later, is_taken):
    """The margin; where it begins within the margin, no less than there; and never less than the floor."""

    def clearance(rows):
        return np.where(np.arange(len(rows)) == 0, at_first, later) if len(rows) > 1 else np.ones(1)

    layer = started(bundle, clearance)
    path = run(layer, velocity(0, 0.5))
    assert layer.counts[COLLISION][0] == (not is_taken) and (path[-1, 1, 0] > 0) == is_taken


@pytest.mark.parametrize("number", [np.nan, -1.5])
def test_invalid_actions_are_rejected(layer, number):
    run(layer, velocity(0, 0.5), ticks=4)
    path = run(layer, velocity(0, number), ticks=20)
    assert layer.counts[INVALID][0] == 20 and layer.counts[REPEATED][0] == layer.counts[LATE][0] == 0
    assert np.isfinite(path).all() and np.all(path[-1, 1] == 0) and layer.cause[0] == ""
    assert run(layer, velocity(0, 0.5), ticks=5)[-1, 1, 0] > 0.1  # it goes on


def test_an_action_at_its_limit_may_round(layer):
    path = run(layer, velocity(0, 1 + 5e-4))
    assert layer.counts[INVALID][0] == 0 and path[-1, 1, 0] > 0


def test_a_path_towards_the_floor_is_not_taken(layer, bundle):
    """The arm stops in front of it at the margin, stays there, and can leave."""
    path = run(layer, velocity(1, 1.0), ticks=60)
    clearance = bundle.clearance_of(path[:, 0])
    assert CONFIG.margin - CONFIG.creep < clearance.min() < CONFIG.margin + 0.05
    assert layer.counts[COLLISION][0] > 10 and np.abs(path[-1, 1]).max() < 1e-3
    assert layer.clearance[0] == pytest.approx(clearance.min(), abs=1e-3)  # measured once in a tick
    before = layer.counts[COLLISION][0]
    back = run(layer, velocity(1, -1.0), ticks=10)
    assert layer.counts[COLLISION][0] == before and back[-1, 1, 1] < -0.5


def test_missing_actions_are_repeated_and_then_the_arm_brakes(layer):
    speed = run(layer, velocity(0, 0.5), ticks=10)[-1, 1, 0]
    repeated = run(layer, velocity(0, np.nan), ticks=CONFIG.repeats, present=False)
    assert layer.counts[REPEATED][0] == CONFIG.repeats and layer.counts[LATE][0] == 0
    assert repeated[-1, 1, 0] == pytest.approx(speed, rel=1e-3)
    braking = run(layer, velocity(0, np.nan), ticks=20, present=False)
    assert layer.counts[LATE][0] == 20 and layer.counts[REPEATED][0] == CONFIG.repeats
    assert np.all(np.diff(braking[:, 1, 0]) <= 1e-9) and np.all(braking[-1, 1] == 0) and layer.cause[0] == ""
    run(layer, velocity(0, 0.5))
    run(layer, velocity(0, np.nan), present=False)
    assert layer.counts[REPEATED][0] == CONFIG.repeats + 1  # a new action may be repeated again


def test_nothing_is_repeated_before_the_first_action(layer):
    path = run(layer, velocity(0, np.nan), ticks=5, present=False)
    assert np.all(path[:, 1] == 0) and not any(count[0] for count in layer.counts.values())


def test_skipped_ticks_are_those_of_a_braking_arm(bundle):
    """The reference goes on along the path on which the robot has braked by itself."""
    braked, skipped = started(bundle), started(bundle)
    for layer in (braked, skipped):
        run(layer, velocity(0, 0.5), ticks=5)
    braked.tick(braked.reference.qpos, braked.reference.qvel, None)
    skipped.skip()
    np.testing.assert_array_equal(braked.reference, skipped.reference)
    assert skipped.counts[LATE][0] == 1 and braked.counts[LATE][0] == 0
    skipped.stop("interrupted")
    skipped.skip()
    assert skipped.counts[LATE][0] == 1


def test_the_braking_path_of_a_target_is_the_one_that_was_checked(bundle):
    """Actions at random, some of them missing; whenever the policy ends, the rest of the path is clear."""
    rng = np.random.default_rng(3)
    for ticks in rng.integers(1, 30, 6):
        layer, paths = started(bundle), []
        for _ in range(ticks):
            paths.append(run(layer, rng.choice([-1.0, 1.0], 7), present=rng.uniform() < 0.8))
        for _ in range(layer.brake_ticks):
            paths.append(run(layer, velocity(0, np.nan), present=False))
        path = np.concatenate(paths)
        clearance = bundle.clearance_of(path[:, 0])
        assert np.all(path[-1, 1] == 0) and clearance.min() > CONFIG.margin - CONFIG.creep - 1e-6


STARTS = {
    "far": (lambda q, v, pose: (q + 0.051, v, pose), safety.START_POSE),
    "moving": (lambda q, v, pose: (q, v + 0.11, pose), safety.NOT_AT_REST),
    "nan": (lambda q, v, pose: (q * np.nan, v, pose), safety.INVALID_STATE),
    "nan velocity": (lambda q, v, pose: (q, v * np.nan, pose), safety.INVALID_STATE),
    "beyond a limit": (lambda q, v, pose: (q + 10, v, pose + 10), safety.START_POSE),
    "folded": (lambda q, v, pose: (bundles.ON_FLOOR[:, None], v, bundles.ON_FLOOR[:, None]), safety.START_CLEARANCE),
}


@pytest.mark.parametrize(("change", "cause"), STARTS.values(), ids=STARTS)
def test_it_starts_only_near_the_start_pose_and_at_rest(bundle, change, cause):
    layer = SafetyLayer(bundle)
    pose = bundle.start_pose[:, None]
    qpos, qvel, pose = change(pose, 0 * pose, pose)
    assert layer.start(qpos, qvel, pose)[0] == cause
    path = run(layer, velocity(0, 1.0), ticks=3)
    assert np.isfinite(path).all() and np.all(path[:, 1] == 0) and layer.cause[0] == cause


@pytest.mark.parametrize(("clearance", "cause"), [(0.0151, ""), (0.0149, safety.START_CLEARANCE)])
def test_the_clearance_of_a_start(bundle, clearance, cause):
    layer, pose = SafetyLayer(bundle, clearance=lambda rows: np.full(len(rows), clearance)), bundle.start_pose[:, None]
    assert layer.start(pose, 0 * pose, pose)[0] == cause


LIMIT = 2.8973  # of joint 1
MEASUREMENTS = {
    "nan": (lambda q, v: (q * np.nan, v), safety.INVALID_STATE),
    "nan velocity": (lambda q, v: (q, v * np.nan), safety.INVALID_STATE),
    "far": (lambda q, v: (q + velocity(4, 0.201)[:, None], v), safety.TRACKING),
}


@pytest.mark.parametrize(("change", "cause"), MEASUREMENTS.values(), ids=MEASUREMENTS)
def test_a_state_that_cannot_be_ends_the_control(layer, change, cause):
    run(layer, velocity(0, 0.5), ticks=5)
    command = layer.tick(*change(layer.reference.qpos, layer.reference.qvel), velocity(0, 0.5)[:, None])
    assert layer.cause[0] == cause and all(np.isfinite(x).all() for x in command.path)
    for _ in range(layer.brake_ticks):
        last = layer.tick(layer.reference.qpos, layer.reference.qvel, velocity(0, 1.0)[:, None])
    assert np.all(last.qvel == 0) and layer.cause[0] == cause
    assert layer.counts[COLLISION][0] == layer.counts[INVALID][0] == 0


def test_an_arm_within_the_bounds_goes_on(layer):
    run(layer, velocity(0, 0.5), ticks=5)
    layer.tick(layer.reference.qpos + velocity(4, 0.199)[:, None], layer.reference.qvel, velocity(0, 0.5)[:, None])
    assert layer.cause[0] == "" and layer.tracking_error[0] == pytest.approx(0.199)


def test_a_blocked_arm_is_not_pushed_on(layer):
    """It brakes where it is, as its reference goes on for 0.4 rad at this speed."""
    block = layer.reference.qpos[0, 0] + 0.15
    for _ in range(40):
        qpos, qvel = layer.reference.qpos.copy(), layer.reference.qvel.copy()
        if qpos[0, 0] > block:
            qpos[0], qvel[0] = block, 0.0
        command = layer.tick(qpos, qvel, velocity(0, 1.0)[:, None])
    assert layer.cause[0] == safety.TRACKING
    assert command.stop[0, 0] - block < 0.01 and np.all(command.qvel == 0)


def test_an_arm_that_is_pushed_away_brakes_within_its_limits(layer, bundle):
    fast = velocity(0, 20.0)[:, None]
    command = layer.tick(layer.reference.qpos + 0.3, fast, None)
    limits = bundle.parameters
    assert layer.cause[0] == safety.TRACKING and np.all(command.path.qvel[..., 0] <= limits.velocity)
    assert 0.3 < command.stop[0, 0] < 0.3 + limits.velocity[0] ** 2 / limits.acceleration[0] + 1


def test_what_has_stopped_an_arm_stays(layer):
    layer.tick(layer.reference.qpos + 0.3, layer.reference.qvel, None)
    layer.tick(layer.reference.qpos * np.nan, layer.reference.qvel, None)
    layer.stop("interrupted")
    assert layer.cause[0] == safety.TRACKING and layer.tracking_error[0] == pytest.approx(0.3)


@pytest.mark.parametrize(("sign", "distance", "cause"), [(1, 0.0049, safety.POSITION), (-1, 0.0049, safety.POSITION),
                                                         (1, 0.0051, ""), (-1, 0.0051, "")])  # fmt: skip
def test_an_arm_near_the_end_of_a_joint_is_stopped(bundle, sign, distance, cause):
    pose = bundle.start_pose.copy()
    pose[0] = sign * (LIMIT - 0.031)
    layer = started(bundle, lambda rows: np.ones(len(rows)), pose=pose)
    pose[0] = sign * (LIMIT - distance)
    layer.tick(pose[:, None], np.zeros((7, 1)), None)
    assert layer.cause[0] == cause


@pytest.mark.parametrize(("clearance", "cause"), [(0.0051, ""), (0.0049, safety.MEASURED_CLEARANCE),
                                                  (np.nan, safety.MEASURED_CLEARANCE)])  # fmt: skip
def test_an_arm_without_clearance_is_stopped(bundle, clearance, cause):
    layer = started(bundle, lambda rows: np.where(rows[:, 0] > 0.1, clearance, 1.0))
    layer.tick(bundle.start_pose[:, None] + velocity(0, 0.15)[:, None], np.zeros((7, 1)), None)
    assert layer.cause[0] == cause


def test_scales_slow_the_reference_down(bundle):
    config, limits = SafetyConfig(velocity_scale=0.3, acceleration_scale=0.2), bundles.parameters()
    path = run(started(bundle, config=config), velocity(0, 1.0), ticks=20)
    assert path[:, 1].max() == pytest.approx(0.3 * limits.velocity[0], rel=1e-3)
    assert path[:, 2].max() == pytest.approx(0.2 * limits.acceleration[0], rel=1e-3)


def test_torque_policies_and_other_ticks_are_rejected(bundle):
    with pytest.raises(ValueError, match="got torque"):
        SafetyLayer(dataclasses.replace(bundle, mode="torque"))
    for control_dt, latency in ((0.02, 0.02), (0.055, 0.02), (0.05, 0.025)):
        with pytest.raises(ValueError, match=f"got {control_dt} s and {latency} s"):
            check_supported("joint_velocity", control_dt, SafetyConfig(latency=latency))
    check_supported("joint_position", 0.03)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("repeats", -1, "one of 0, 1, 2, ..."),
        ("velocity_scale", 30, "a number above 0, at most 1"),
        ("acceleration_scale", 0.0, "a number above 0, at most 1"),
        ("margin", -0.01, "a finite number, at least 0"),
        ("latency", np.nan, "a finite number, at least 0"),
        ("position", "0.05", "a finite number, at least 0"),
    ],
)
def test_invalid_thresholds_are_rejected_in_one_line(name, value, expected):
    with pytest.raises(ValueError, match=f"SafetyConfig: {name}: expected {re.escape(expected)}, got {value!r}$"):
        SafetyConfig(**{name: value})


def test_robots_of_a_batch_do_not_depend_on_each_other(bundle):
    rng, robots = np.random.default_rng(0), 3
    actions, present = rng.uniform(-1, 1, (8, 7, robots)), rng.uniform(size=(8, robots)) < 0.6
    together, alone = started(bundle, robots=robots), [started(bundle) for _ in range(robots)]
    for action, is_present in zip(actions, present, strict=True):
        command = together.tick(together.reference.qpos, together.reference.qvel, action, is_present)
        for i, layer in enumerate(alone):
            part = slice(i, i + 1)
            single = layer.tick(layer.reference.qpos, layer.reference.qvel, action[:, part], is_present[part])
            # What is left of a motion where a path ends that is at rest: others of the batch may take longer.
            np.testing.assert_allclose(command.path.qpos[..., i], single.path.qpos[..., 0], atol=1e-5)
            np.testing.assert_allclose(command.stop[:, i], single.stop[:, 0], atol=1e-5)
    assert together.counts[LATE].sum() + together.counts[REPEATED].sum() > 3
    together.release(np.array([True, False, False]), "aborted")
    assert list(together.cause) == ["aborted", "", ""]
