"""The safety layer: what it rejects, why it stops, and that a checked braking path is always left."""

import dataclasses
import re

import numpy as np
import pytest

from mimic.control.joint_control import PERIOD
from mimic.deploy import measurements
from mimic.deploy.clearance import Clearance
from mimic.deploy.config import SafetyConfig
from mimic.deploy.safety import COLLISION, INVALID, LATE, MEASURED_CLEARANCE, REPEATED, SafetyLayer, check_supported
from tests.helpers import bundles

CONFIG = SafetyConfig()
ONE = np.ones(1, bool)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return bundles.make_bundle(tmp_path_factory.mktemp("bundles") / "bundle")


@pytest.fixture
def layer(bundle):
    """A layer of one arm at rest in its start pose."""
    layer = SafetyLayer(bundle, Clearance(bundle))
    qpos = bundle.start_pose[:, None]
    assert layer.start(qpos, 0 * qpos, qpos)[0] == ""
    return layer


def run(layer, action, ticks=1, present=True):
    """Ticks with an action on an arm that follows its reference exactly; the reference after each period."""
    references = []
    for _ in range(ticks):
        for period in range(50):
            layer.period(layer.reference.qpos, layer.reference.qvel)
            if period == 0:
                layer.tick(np.asarray(action, float)[:, None], ONE & present)
            layer.work()
            references.append(layer.reference)
    return references


def velocity(joint, value):
    return np.where(np.arange(7) == joint, value, 0.0)


def test_a_check_has_the_clearance_of_the_whole_path(layer):
    run(layer, velocity(0, 0.5))
    assert len(layer._path.path) == layer._path.samples == len(layer._path_clearance)
    poses = layer._path.path[:, :, 0]
    np.testing.assert_allclose(layer._path_clearance[:, 0], layer._clearance(poses), atol=1e-6)


def test_a_path_that_is_checked_in_part_is_rejected(layer):
    layer._parts[-1] -= 1  # the check does not come to the end of the path
    references = run(layer, velocity(0, 0.5))
    assert layer.counts[COLLISION][0] == 1 and all(reference.qvel[0, 0] == 0 for reference in references)


def test_a_path_whose_clearance_is_unknown_is_rejected(layer):
    known, calls = layer._clearance, []

    def once_unknown(poses):
        calls.append(len(poses))
        clearance = known(poses)
        clearance[-1] = np.nan if len(calls) == 5 else clearance[-1]
        return clearance

    layer._clearance = once_unknown
    references = run(layer, velocity(0, 0.5))
    assert len(calls) > 5 and layer.counts[COLLISION][0] == 1
    assert all(reference.qvel[0, 0] == 0 for reference in references)


def test_an_accepted_target_moves_the_arm(layer):
    references = run(layer, velocity(0, 0.5), ticks=20)
    assert references[-1].qvel[0, 0] == pytest.approx(0.5 * bundles.parameters().velocity[0], rel=1e-3)
    assert references[CONFIG.check_periods - 1].qvel[0, 0] == 0 < references[CONFIG.check_periods + 2].qvel[0, 0]
    assert not any(count[0] for count in layer.counts.values())


def test_a_path_begins_where_the_reference_will_be(layer):
    """When the new target begins to act, to a twentieth of what the reference moves in a period."""
    references = run(layer, velocity(0, 0.5), ticks=5)
    begin = references[-50 + CONFIG.check_periods - 1]  # the last one with the old target
    assert begin.qvel[0, 0] > 0.9
    assert abs(layer._path.path[0, 0, 0] - begin.qpos[0, 0]) < 0.05 * begin.qvel[0, 0] * PERIOD


def test_actions_are_taken_between_the_torque_and_the_work_of_a_period(layer):
    action = velocity(0, 0.5)[:, None]
    with pytest.raises(RuntimeError, match="tick: expected after `period` and before `work`"):
        layer.tick(action, ONE)
    with pytest.raises(RuntimeError, match="observed_reference: expected after `period` and before `work`"):
        _ = layer.observed_reference
    layer.period(layer.reference.qpos, layer.reference.qvel)
    layer.work()
    with pytest.raises(RuntimeError, match="tick: expected after `period`"):
        layer.tick(action, ONE)
    assert not layer.is_checking and not layer.has_action[0] and not any(count[0] for count in layer.counts.values())


def test_a_path_begins_with_the_time_that_is_left_to_the_last_target(bundle):
    """Without grace it is exactly the time of the check, so that the reference never brakes between two targets."""
    layer = SafetyLayer(bundle, Clearance(bundle), config=SafetyConfig(grace=0.0))
    pose = bundle.start_pose[:, None]
    layer.start(pose, 0 * pose, pose)
    references = run(layer, velocity(0, 0.5), ticks=5)
    begin = references[-50 + CONFIG.check_periods - 1]
    assert abs(layer._path.path[0, 0, 0] - begin.qpos[0, 0]) < 0.05 * begin.qvel[0, 0] * PERIOD


@pytest.mark.parametrize("number", [np.nan, np.inf, 1.5])
def test_invalid_actions_are_rejected(layer, number):
    references = run(layer, velocity(0, 0.5), ticks=4) + run(layer, velocity(0, number), ticks=20)
    assert layer.counts[INVALID][0] == 20 and np.isfinite(references[-1].qpos).all()
    assert abs(references[-1].qvel).max() < 1e-6 and layer.cause[0] == ""
    assert run(layer, velocity(0, 0.5), ticks=5)[-1].qvel[0, 0] > 0.1  # it goes on


def test_a_path_towards_the_floor_is_not_taken(layer, bundle):
    """The arm stops in front of it at the margin, stays there, and can leave."""
    references = run(layer, velocity(1, 1.0), ticks=60)
    clearance = Clearance(bundle)(np.concatenate([r.qpos.T for r in references]))
    assert CONFIG.margin - CONFIG.creep < clearance.min() < CONFIG.margin + 0.05
    assert layer.counts[COLLISION][0] > 10 and abs(references[-1].qvel).max() < 1e-3
    assert layer.clearance[0] == pytest.approx(clearance.min(), abs=1e-3)  # of one in several periods
    before = layer.counts[COLLISION][0]
    back = run(layer, velocity(1, -1.0), ticks=10)
    assert layer.counts[COLLISION][0] == before and back[-1].qvel[1, 0] < -0.5


def test_missing_actions_are_repeated_and_then_the_arm_brakes(layer):
    run(layer, velocity(0, 0.5), ticks=10)
    speed = layer.reference.qvel[0, 0]
    repeated = run(layer, velocity(0, np.nan), ticks=CONFIG.repeats, present=False)
    assert layer.counts[REPEATED][0] == CONFIG.repeats and layer.counts[LATE][0] == 0
    assert repeated[-1].qvel[0, 0] == pytest.approx(speed, rel=1e-3)
    braking = run(layer, velocity(0, np.nan), ticks=20, present=False)
    assert layer.counts[LATE][0] == 20 and layer.counts[REPEATED][0] == CONFIG.repeats
    limits = bundles.parameters()
    qacc = np.array([r.qacc[0, 0] for r in braking])
    assert np.abs(qacc).max() <= limits.acceleration[0] * (1 + 1e-9)
    assert np.abs(np.diff(qacc)).max() <= limits.jerk[0] * PERIOD * (1 + 1e-9)
    assert abs(braking[-1].qvel).max() < 1e-6 and layer.cause[0] == ""


def test_the_braking_path_of_a_target_is_the_one_that_was_checked(bundle):
    """Actions at random, some of them missing; whenever the policy ends, the rest of the path is clear."""
    rng = np.random.default_rng(3)
    for ticks in rng.integers(1, 30, 20):
        layer = SafetyLayer(bundle, Clearance(bundle))
        qpos = bundle.start_pose[:, None]
        layer.start(qpos, 0 * qpos, qpos)
        references = []
        for _ in range(ticks):
            references += run(layer, rng.choice([-1.0, 1.0], 7), present=rng.uniform() < 0.8)
        for _ in range(1500):
            layer.period(layer.reference.qpos, layer.reference.qvel)
            references.append(layer.reference)
        assert np.abs(layer.reference.qvel).max() < 1e-4
        clearance = Clearance(bundle)(np.concatenate([r.qpos.T for r in references]))
        assert clearance.min() > CONFIG.margin - CONFIG.creep - 0.005  # 5 mm: between samples, and error of the path


STARTS = {
    "far": (lambda q, v, pose: (q + 0.1, v, pose), measurements.START_POSE),
    "moving": (lambda q, v, pose: (q, v + 0.2, pose), measurements.NOT_AT_REST),
    "nan": (lambda q, v, pose: (q * np.nan, v, pose), measurements.INVALID_STATE),
    "beyond a limit": (lambda q, v, pose: (q + 10, v, pose + 10), measurements.START_POSE),
    "folded": (lambda q, v, pose: (bundles.ON_FLOOR[:, None], v, bundles.ON_FLOOR[:, None]), "start clearance"),
}


@pytest.mark.parametrize(("change", "cause"), STARTS.values(), ids=STARTS)
def test_it_starts_only_near_the_start_pose_and_at_rest(bundle, change, cause):
    layer = SafetyLayer(bundle, Clearance(bundle))
    pose = bundle.start_pose[:, None]
    qpos, qvel, pose = change(pose, 0 * pose, pose)
    assert layer.start(qpos, qvel, pose)[0] == cause
    for period in range(100):
        torque = layer.period(np.nan_to_num(qpos), qvel)
        if period == 0:
            layer.tick(velocity(0, 1.0)[:, None], ONE)
        layer.work()
    assert np.isfinite(torque).all() and np.all(layer.reference.qvel[0] < 0.01)


LIMIT = 2.8973  # of joint 1
MEASUREMENTS = {
    "nan": (lambda q, v: (q * np.nan, v), measurements.INVALID_STATE),
    "nan velocity": (lambda q, v: (q, v * np.nan), measurements.INVALID_STATE),
    "jump": (lambda q, v: (q + 0.1, v), measurements.JUMP),
}


@pytest.mark.parametrize(("change", "cause"), MEASUREMENTS.values(), ids=MEASUREMENTS)
def test_an_implausible_state_ends_the_control(layer, change, cause):
    """The torque is then that of the reference's motion alone, and goes to zero: the robot holds itself."""
    run(layer, velocity(0, 0.5), ticks=5)
    before = layer.torque.copy()
    changed = change(layer.reference.qpos, layer.reference.qvel)
    for _ in range(1500):
        torque = layer.period(*changed)
        assert np.abs(torque - before).max() <= 1.0 + 1e-9
        before = torque
    assert layer.cause[0] == cause and np.abs(torque).max() < 1e-3
    run(layer, velocity(0, 1.0), ticks=3)
    assert abs(layer.reference.qvel).max() < 1e-2 and layer.cause[0] == cause


def drift(layer, change, periods=600):
    """An arm that deviates slowly from its reference."""
    for period in range(periods):
        fraction = period / periods
        qpos, qvel = layer.reference.qpos + fraction * change[0], layer.reference.qvel + fraction * change[1]
        layer.period(qpos, qvel)
        layer.work()
    return str(layer.cause[0])


def test_an_arm_that_does_not_follow_is_stopped(layer):
    assert drift(layer, (velocity(4, 0.3)[:, None], 0)) == measurements.TRACKING


def test_a_blocked_arm_is_not_pushed_on(layer):
    """It brakes where it is, as its reference goes on for 0.4 rad at this speed; the torque changes within its rate."""
    block, before = layer.reference.qpos[0, 0] + 0.15, layer.torque.copy()
    for period in range(1000):
        qpos, qvel = layer.reference.qpos.copy(), layer.reference.qvel.copy()
        if qpos[0, 0] > block:
            qpos[0], qvel[0] = block, 0.0
        torque = layer.period(qpos, qvel)
        if period % 50 == 0:
            layer.tick(velocity(0, 1.0)[:, None], ONE)
        layer.work()
        assert np.abs(torque - before).max() <= 1.0 + 1e-9
        before = torque
    assert layer.cause[0] == measurements.TRACKING
    assert layer.reference.qpos[0, 0] - block < 0.01 and abs(torque[0, 0]) < 10  # of 87 N m
    assert np.abs(layer.reference.qvel).max() < 1e-3


def test_an_arm_that_is_too_fast_is_stopped(layer):
    assert drift(layer, (0, velocity(0, -2.3)[:, None])) == measurements.VELOCITY


def test_noise_of_the_velocity_does_not_stop_an_arm(layer):
    fast = velocity(0, 2.3)[:, None]
    for period in range(100):
        layer.period(layer.reference.qpos, layer.reference.qvel + fast * (period % 3 != 0))
    assert layer.cause[0] == ""


def test_an_arm_near_the_end_of_a_joint_is_stopped(bundle):
    layer, pose = SafetyLayer(bundle, Clearance(bundle)), bundle.start_pose[:, None].copy()
    pose[0] = LIMIT - 0.031
    assert layer.start(pose, 0 * pose, pose)[0] == ""
    assert drift(layer, (velocity(0, 0.03)[:, None], 0)) == measurements.POSITION


def test_an_arm_without_clearance_is_stopped(bundle):
    layer = SafetyLayer(bundle, lambda rows: np.where(rows[:, 0] > 0.1, 0.0, 1.0), config=SafetyConfig(tracking=1.0))
    pose = bundle.start_pose[:, None]
    layer.start(pose, 0 * pose, pose)
    assert drift(layer, (velocity(0, 0.2)[:, None], 0)) == MEASURED_CLEARANCE


def test_an_arm_beyond_its_speed_is_slowed_down(bundle):
    """Within the limits of the torque and of its rate."""
    torques = {}
    for slow_down in (0.96, 10.0):
        layer = SafetyLayer(bundle, Clearance(bundle), config=SafetyConfig(slow_down=slow_down, velocity=10.0))
        pose = bundle.start_pose[:, None]
        layer.start(pose, 0 * pose, pose)
        run(layer, velocity(0, 1.0), ticks=15)
        before = layer.torque.copy()
        for _ in range(100):
            torque = layer.period(layer.reference.qpos, velocity(0, 2.14)[:, None])
            assert np.abs(torque - before).max() <= 1.0 + 1e-9
            before = torque
        torques[slow_down] = torque[0, 0]
    assert -87 <= torques[0.96] < torques[10.0] - 1 < 0


@pytest.mark.parametrize(("beyond", "speed", "damping"), [(0.02, 0.1, 4), (0.02, -0.1, 1), (-0.005, 0.1, 1)])
def test_an_arm_that_leaves_the_range_of_its_reference_is_braked(bundle, beyond, speed, damping):
    """Only outwards, and only beyond the end of the range; within the limit of the torque."""
    layer, parameters = SafetyLayer(bundle, lambda rows: np.ones(len(rows))), bundle.parameters
    pose = bundle.start_pose[:, None].copy()
    pose[0] = parameters.upper[0] - 0.01
    layer.start(pose, 0 * pose, pose)
    measured = pose.copy()
    measured[0] = parameters.upper[0] + beyond
    for _ in range(200):
        torque = layer.period(measured, velocity(0, speed)[:, None])
    expected = -parameters.stiffness[0] * (0.01 + beyond) - damping * parameters.damping[0] * speed
    assert abs(expected) > 1 and not layer.cause[0]
    assert torque[0, 0] == pytest.approx(max(expected, -parameters.torque[0]), rel=1e-6)


def test_softness_is_bounded(tmp_path):
    action = bundles.constant(*[0.0] * 7, *[-1.0] * 7)
    bundle = bundles.make_bundle(tmp_path / "soft", action, mode="joint_impedance")
    layer, pose = SafetyLayer(bundle, Clearance(bundle)), bundle.start_pose[:, None]
    layer.start(pose, 0 * pose, pose)
    run(layer, [0.0] * 7 + [-1.0] * 7)
    before = [layer.period(pose - 0.001, 0 * pose) for _ in range(20)][-1]
    stiffness = before[:, 0] / 0.001 / bundles.parameters().stiffness
    np.testing.assert_allclose(stiffness, CONFIG.min_stiffness, rtol=1e-6)


def test_torque_policies_and_short_ticks_are_rejected(bundle):
    with pytest.raises(ValueError, match="got torque"):
        SafetyLayer(dataclasses.replace(bundle, mode="torque"), Clearance(bundle))
    with pytest.raises(ValueError, match="control_dt, grace: expected a tick of more than 20 ms"):
        SafetyLayer(dataclasses.replace(bundle, control_dt=0.01), Clearance(bundle))


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("check_periods", 0, "one of 2, 4, 6, ..."),
        ("check_periods", 1, "one of 2, 4, 6, ..."),
        ("check_periods", 21, "one of 2, 4, 6, ..."),
        ("check_periods", 20.0, "one of 2, 4, 6, ..."),
        ("repeats", -1, "one of 0, 1, 2, ..."),
        ("velocity_periods", 0, "one of 1, 2, 3, ..."),
        ("velocity_scale", 30, "a number above 0, at most 1"),
        ("acceleration_scale", 0.0, "a number above 0, at most 1"),
        ("margin", -0.01, "a finite number, at least 0"),
        ("grace", np.nan, "a finite number, at least 0"),
        ("tracking", np.inf, "a finite number, at least 0"),
        ("jump", "0.05", "a finite number, at least 0"),
    ],
)
def test_invalid_thresholds_are_rejected_in_one_line(name, value, expected):
    with pytest.raises(ValueError, match=f"SafetyConfig: {name}: expected {re.escape(expected)}, got {value!r}$"):
        SafetyConfig(**{name: value})


def test_a_driver_may_use_its_array_again(layer, bundle):
    qpos = bundle.start_pose[:, None].copy()
    layer.period(qpos, 0 * qpos)
    qpos[3] += 2 * CONFIG.jump
    layer.period(qpos, 0 * qpos)
    assert layer.cause[0] == measurements.JUMP


def test_what_the_layer_supports_is_known_without_a_bundle():
    check_supported("joint_velocity", 0.05)
    with pytest.raises(ValueError, match="got torque"):
        check_supported("torque", 0.05)
    with pytest.raises(ValueError, match="multiple of 10 ms together, got 0.055 s and 0.02 s"):
        check_supported("joint_impedance", 0.055)
    check_supported("joint_impedance", 0.055, SafetyConfig(grace=0.025))


def test_robots_of_a_batch_do_not_depend_on_each_other(bundle):
    rng, pose = np.random.default_rng(0), np.tile(bundle.start_pose[:, None], (1, 3))
    actions = rng.uniform(-1, 1, (6, 7, 3))
    present = rng.uniform(size=(6, 3)) < 0.7
    together = SafetyLayer(bundle, Clearance(bundle), 3)
    alone = [SafetyLayer(bundle, Clearance(bundle)) for _ in range(3)]
    together.start(pose, 0 * pose, pose)
    for i, layer in enumerate(alone):
        layer.start(pose[:, i : i + 1], 0 * pose[:, :1], pose[:, i : i + 1])
    for action, is_present in zip(actions, present, strict=True):
        for period in range(50):
            together.period(together.reference.qpos, together.reference.qvel)
            if period == 0:
                together.tick(action, is_present)
            together.work()
            for i, layer in enumerate(alone):
                layer.period(layer.reference.qpos, layer.reference.qvel)
                if period == 0:
                    layer.tick(action[:, i : i + 1], is_present[i : i + 1])
                layer.work()
    for i, layer in enumerate(alone):
        np.testing.assert_allclose(together.reference.qpos[:, i], layer.reference.qpos[:, 0], atol=1e-12)
