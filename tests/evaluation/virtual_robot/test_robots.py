"""Virtual robots: their physics is MuJoCo's and ours, and each reflex has a case in which it fires alone."""

import copy
import dataclasses

import mujoco
import numpy as np
import pytest

from mimic.control.joint_control import PERIOD
from mimic.evaluation.virtual_robot import robots as reflexes
from mimic.evaluation.virtual_robot.draws import edge_cases
from mimic.physics.world import WorldConfig
from tests.helpers.bundles import FOLDED, ON_FLOOR, panda
from tests.helpers.virtual_robots import hardware, home, model, virtual, world

GRAVITY = WorldConfig(gravity=True)


def ramp(robots, torque, periods, rate=0.5):
    """Torques that grow to a value; returns after the given periods, or at an abort."""
    for _ in range(periods):
        change = np.clip(torque - robots.torque, -rate, rate)
        robots.step(robots.torque + change)
        if not robots.is_active.any():
            return


def test_without_a_world_it_is_mujoco():
    """The model of the arm alone, with the same integrator: equal to the bit."""
    robots, arm = virtual(), copy.copy(panda().model)
    arm.opt.timestep, arm.opt.integrator = PERIOD, mujoco.mjtIntegrator.mjINT_EULER
    data = mujoco.MjData(arm)
    data.qpos[:] = home()
    rng, torque = np.random.default_rng(0), np.zeros(7)
    for _ in range(500):
        torque = torque + rng.uniform(-0.05, 0.05, 7)
        data.qfrc_applied[:] = torque
        mujoco.mj_step(arm, data)
        robots.step(torque[None])
    assert np.abs(robots.qvel).max() > 0.1
    np.testing.assert_array_equal(robots.qpos[0], data.qpos)


def test_gravity_is_compensated_but_for_its_error():
    """Torques that carry four fifths of the weight of links and payload leave what an error of a fifth leaves."""
    assert virtual_after(GRAVITY) == pytest.approx(home(), abs=1e-9)
    loaded = dataclasses.replace(GRAVITY, payload=[3.0, 3.0], payload_lever=[0.1, 0.1])
    assert virtual_after(loaded) == pytest.approx(home(), abs=1e-9)
    error = dataclasses.replace(loaded, gravity_error=[0.2, 0.2])
    heavy = virtual(dataclasses.replace(loaded, gravity_error=[1.0, 1.0]))._models[0]
    expected, at_rest = mujoco.MjData(heavy), mujoco.MjData(heavy)
    expected.qpos[:] = home()
    for _ in range(100):
        at_rest.qpos[:] = expected.qpos
        mujoco.mj_forward(heavy, at_rest)
        expected.qfrc_applied[:] = 0.8 * at_rest.qfrc_bias
        mujoco.mj_step(heavy, expected)
    assert np.abs(expected.qpos - home()).max() > 1e-3
    np.testing.assert_allclose(virtual_after(error, 100), expected.qpos, atol=1e-9)


def virtual_after(config, periods=200):
    robots = virtual(config)
    for _ in range(periods):
        robots.step(np.zeros((1, 7)))
    return robots.qpos[0]


def test_payload_and_link_masses_are_those_of_the_world():
    config = dataclasses.replace(GRAVITY, payload=[2.0, 2.0], payload_lever=[0.1, 0.1], link_mass=[1.1, 1.1])
    loaded, plain = virtual(config)._models[0], virtual(GRAVITY)._models[0]
    links = plain.body_mass.sum()
    assert loaded.body_mass.sum() == pytest.approx(1.1 * links + 2.0)
    data, other = mujoco.MjData(loaded), mujoco.MjData(plain)
    for each, of in ((data, loaded), (other, plain)):
        each.qpos[:] = home()
        mujoco.mj_forward(of, each)
    tip = data.xipos[loaded.body("payload").id]
    end = data.xpos[loaded.body("payload").id]
    np.testing.assert_allclose(tip - end, [0, 0, -0.1], atol=1e-6)  # the last link points down in the ready pose
    inertia = np.zeros((2, 7, 7))
    for row, (each, of) in enumerate(((data, loaded), (other, plain))):
        mujoco.mj_fullM(of, each, inertia[row])
    assert inertia[0, 1, 1] > inertia[1, 1, 1] + 2.0 * 0.15  # 2 kg some 0.4 m from the shoulder


def test_friction_and_motor_gain_act_against_and_on_the_torque():
    friction = WorldConfig(friction=[1.0, 1.0])
    held = virtual(friction)
    ramp(held, np.array([0, 0, 0, 0, 0, 0.12, 0]), 400)
    free = virtual()
    ramp(free, np.array([0, 0, 0, 0, 0, 0.12, 0]), 400)
    assert abs(held.qvel[0, 5]) < 0.6 * abs(free.qvel[0, 5])
    strong = virtual(WorldConfig(motor_gain=[1.2, 1.2]))
    ramp(strong, np.array([0, 0, 0, 0, 0, 0.1, 0]), 400)
    np.testing.assert_allclose(strong.qpos, free.qpos, atol=1e-9)


def test_measurements_have_bias_and_noise():
    config = WorldConfig(position_bias=0.01, position_noise=0.001, velocity_noise=0.02)
    robots = virtual(config, robots=20)
    measured = [robots.measure() for _ in range(300)]
    qpos, qvel = (np.stack([m[k] for m in measured]) for k in (0, 1))
    error = qpos - robots.qpos
    assert 0.0009 < error.std(axis=0).mean() < 0.0011 and 0.018 < qvel.std() < 0.022
    bias = error.mean(axis=0)
    assert 0.008 < np.abs(bias).max() < 0.011 and bias.std() > 0.004


def aborted(robots):
    return robots.cause[0]


def test_start_pose():
    outside = home()
    outside[3] = 0.0  # joint 4 cannot be straight
    assert aborted(virtual(pose=outside)) == reflexes.START_POSE


def test_position_limit():
    near = home()
    near[0] = 2.89
    robots = virtual(pose=near)
    ramp(robots, np.array([8.0, 0, 0, 0, 0, 0, 0]), 400)
    assert aborted(robots) == reflexes.POSITION and robots.qpos[0, 0] > 2.8973


def test_velocity_limit():
    robots = virtual()
    ramp(robots, np.array([0, 0, 0, 0, 0, 0, 5.0]), 400)
    assert aborted(robots) == reflexes.VELOCITY and abs(robots.qvel[0, 6]) > 2.61


def test_torque_limit():
    """Joint 7, without a velocity limit, which it would reach before."""
    robots = virtual()
    limits = dataclasses.replace(model().limits, velocity=100 * model().limits.velocity)
    robots._robot = dataclasses.replace(model(), limits=limits)
    ramp(robots, np.array([0, 0, 0, 0, 0, 0, 12.0]), 24)
    assert aborted(robots) == ""
    robots.step(robots.torque + np.array([0, 0, 0, 0, 0, 0, 0.1]))
    assert aborted(robots) == reflexes.TORQUE


@pytest.mark.parametrize("torque", [1.01, np.nan])
def test_torque_rate(torque):
    robots = virtual()
    robots.step(np.full((1, 7), 1.0))
    assert aborted(robots) == ""
    robots.step(np.full((1, 7), 1.0 + torque))
    assert aborted(robots) == reflexes.TORQUE_RATE


@pytest.mark.parametrize(
    ("pose", "cause"), [(ON_FLOOR, reflexes.FLOOR_CONTACT), (FOLDED, reflexes.SELF_CONTACT)], ids=["floor", "self"]
)
def test_contacts(pose, cause):
    contacts = WorldConfig(gravity=True, contacts=True)
    robots = virtual(contacts, pose=pose)
    robots.step(np.zeros((1, 7)))
    assert aborted(robots) == cause
    without = virtual(GRAVITY, pose=pose)
    without.step(np.zeros((1, 7)))
    assert aborted(without) == ""


def test_stops_hold_a_joint():
    near = home()
    near[0] = 2.85
    held = virtual(WorldConfig(stops=True), pose=near)
    free = virtual(pose=near)
    for robots in (held, free):
        robots._robot = dataclasses.replace(model(), limits=dataclasses.replace(
            model().limits, position=model().limits.position * 2))  # fmt: skip
        ramp(robots, np.array([8.0, 0, 0, 0, 0, 0, 0]), 700)
    assert free.qpos[0, 0] > 2.95 > held.qpos[0, 0]


def test_a_robot_that_aborted_stands_still_and_others_go_on():
    robots = virtual(robots=2)
    robots.step(np.array([[2.0] * 7, [0.5] * 7]))
    before = robots.qpos.copy()
    for _ in range(50):
        robots.step(robots.torque)
    assert list(robots.is_active) == [False, True]
    assert np.array_equal(robots.qpos[0], before[0]) and not np.array_equal(robots.qpos[1], before[1])


def test_draws_are_within_their_ranges_and_at_their_edges():
    config = hardware()
    drawn = world(config, 500)
    for name in ("gravity_error", "payload", "link_mass", "friction", "motor_gain", "observation_delay"):
        minimum, maximum = getattr(config, name)
        values = getattr(drawn, name)
        assert minimum <= values.min() < values.max() <= maximum
    assert drawn.link_mass.shape == (500, 7) and np.abs(drawn.position_bias).max() <= config.position_bias
    cases = dict((name, (case, edge)) for name, case, edge in edge_cases(config))
    assert len(cases) == 2 * 8 + 3 and cases["payload=3"][0].payload == [3.0, 3.0]
    largest = world(config, 5, edge="maximum")
    assert np.all(largest.payload == 3) and np.all(largest.action_delay == 3) and np.all(largest.start_offset > 0)
    corners = world(config, 50, edge="corners")
    assert set(np.unique(corners.payload)) == {0, 3}
