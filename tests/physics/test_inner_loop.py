"""The inner loop against C MuJoCo, which simulates gravity, payload, friction and damping on its own."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mimic.arms.arm import build_arm
from mimic.base.fused_kernel import LaunchConfig
from mimic.control import joint_control
from mimic.control.joint_control import MODES, PERIOD, JointParameters, Reference
from mimic.envs import env_config
from mimic.envs.world_env import plant_of
from mimic.physics.inner_loop import LoopState, flattened, gpu_kernel, make_inner_loop
from mimic.physics.plant import GRAVITY, Draw, end_of_last_link
from tests.helpers.lowering import gpu_program

PERIODS = 50
FIELDS = {"limits": "hardware", "control_dt": 0.05, "world": {"gravity": True, "stops": True}}


def make_arm_and_plant():
    """A Panda of which three joints are locked."""
    config = env_config("panda4dof", **FIELDS)
    arm = build_arm(config.learner, config.limits)
    return arm, plant_of(config, arm)


@pytest.fixture(scope="module")
def arm_and_plant():
    return make_arm_and_plant()


def draw_for(joints: int, seed: int = 0) -> Draw:
    rng = np.random.default_rng(seed)
    return Draw(
        link_mass=jnp.asarray(rng.uniform(0.8, 1.2, joints)),
        payload=jnp.asarray(2.0),
        payload_lever=jnp.asarray(0.07),
        gravity_error=jnp.asarray(1.0),  # no compensation: all of gravity
        friction=jnp.asarray(rng.uniform(0.5, 1.5, joints)),
        gain=jnp.asarray(rng.uniform(0.9, 1.1, joints)),
        bias=jnp.asarray(rng.uniform(-0.01, 0.01, joints)),
        observation_delay=jnp.asarray(0),
        action_delay=jnp.asarray(0),
    )


def mujoco_model(arm, draw: Draw) -> mujoco.MjModel:
    """The arm of a draw in C MuJoCo, with its payload as part of the last body."""
    model = copy.copy(arm.model)
    factors = np.asarray(draw.link_mass)
    last, moving = model.nbody - 1, np.unique(model.jnt_bodyid)
    assert len(moving) == len(factors)
    model.body_mass[moving] *= factors
    model.body_inertia[moving] *= factors[:, None]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    tip, along = end_of_last_link(arm)  # the base frame of these arms is the world
    place = data.xmat[last].reshape(3, 3).T @ (tip + float(draw.payload_lever) * along - data.xpos[last])
    masses = model.body_mass[last], float(draw.payload)
    centre = (masses[0] * model.body_ipos[last] + masses[1] * place) / sum(masses)
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[last])
    axes = axes.reshape(3, 3)
    tensor = axes @ np.diag(model.body_inertia[last]) @ axes.T
    for mass, point in zip(masses, (model.body_ipos[last], place), strict=True):
        lever = point - centre
        tensor = tensor + mass * (lever @ lever * np.eye(3) - np.outer(lever, lever))
    moments, axes = np.linalg.eigh(tensor)
    axes[:, 0] *= np.linalg.det(axes)
    model.body_mass[last], model.body_ipos[last], model.body_inertia[last] = sum(masses), centre, moments
    mujoco.mju_mat2Quat(model.body_iquat[last], axes.ravel())
    model.opt.timestep, model.opt.integrator = PERIOD, mujoco.mjtIntegrator.mjINT_EULER
    model.opt.gravity = [0, 0, -GRAVITY * float(draw.gravity_error)]
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def simulate_in_mujoco(model, home, plant, draw: Draw, mode: str, targets) -> np.ndarray:
    """Angles after each tick of a model from its pose at home, by C MuJoCo and the controller in NumPy."""
    joints, constants = model.nv, plant.constants
    data = mujoco.MjData(model)
    data.qpos[:] = home
    reference = Reference(data.qpos.copy(), np.zeros(joints), np.zeros(joints))
    limits = joint_control.reference_limits(constants.parameters)
    torque, rows = np.zeros(joints), []
    for target in targets:
        for _ in range(PERIODS):
            if mode != "torque":
                reference = joint_control.next_reference(mode, reference, target, limits, np)
            qpos = data.qpos + np.asarray(draw.bias)
            torque = joint_control.joint_torque(
                mode, qpos, data.qvel, reference, target, torque, constants.parameters, np
            )
            level = np.asarray(draw.friction) * plant.friction
            friction = level * np.tanh(constants.friction_rate * data.qvel)
            data.qfrc_applied[:] = np.asarray(draw.gain) * torque - friction
            mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    return np.stack(rows)


def start_of(arm, dtype) -> LoopState:
    home = np.asarray(arm.embodiment.home, dtype)
    zero = np.zeros_like(home)
    return LoopState(home, zero, Reference(home, zero, zero), zero)


def targets_for(arm, plant, mode: str, ticks: int):
    """Random targets of one second, far from the stops."""
    joints, rng = arm.embodiment.num_joints, np.random.default_rng(3)
    parameters = JointParameters(*map(np.asarray, plant.constants.parameters))
    home = np.asarray(arm.embodiment.home)
    reference = Reference(home, np.zeros(joints), np.zeros(joints))
    scale = 0.1 if mode == "torque" else 0.4
    actions = scale * rng.uniform(-1, 1, (ticks, joints))
    return [joint_control.action_target(mode, action, reference, parameters, np) for action in actions]


@pytest.mark.parametrize("mode", MODES)
def test_a_second_is_that_of_c_mujoco(arm_and_plant, mode):
    """With gravity, payload, friction, damping, PD control and errors of gain and angle; float32."""
    arm, plant = arm_and_plant
    draw, targets = draw_for(arm.embodiment.num_joints), targets_for(arm, plant, mode, 20)
    if mode == "torque":  # without PD control it would fall into its stops
        draw = dataclasses.replace(draw, gravity_error=jnp.asarray(0.05))
    expected = simulate_in_mujoco(mujoco_model(arm, draw), arm.embodiment.home, plant, draw, mode, targets)
    draw = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), draw)
    loop, state, rows = jax.jit(make_inner_loop(mode, plant.constants, PERIODS)), start_of(arm, np.float32), []
    episode = jax.jit(plant.episode)(draw)
    for target in targets:
        state = loop(episode, state, jnp.asarray(target, jnp.float32))
        rows.append(state.qpos)
    lower, upper = np.asarray(arm.embodiment.joint_range).T
    assert np.all((expected > lower) & (expected < upper))
    assert np.abs(expected - np.asarray(arm.embodiment.home)).max() > 0.1
    assert np.abs(np.stack(rows) - expected).max() < 1e-4  # rad, the target of the project


def test_in_double_precision_only_rounding_is_left(x64):
    arm, plant = make_arm_and_plant()
    draw, targets = draw_for(arm.embodiment.num_joints, 1), targets_for(arm, plant, "joint_position", 5)
    home = arm.embodiment.home
    expected = simulate_in_mujoco(mujoco_model(arm, draw), home, plant, draw, "joint_position", targets)
    loop, state = jax.jit(make_inner_loop("joint_position", plant.constants, PERIODS)), start_of(arm, np.float64)
    episode = plant.episode(jax.tree.map(jnp.asarray, draw))
    for target in targets:
        state = loop(episode, state, jnp.asarray(target, jnp.float64))
    np.testing.assert_allclose(state.qpos, expected[-1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("mode", [pytest.param("torque", marks=pytest.mark.slow), "joint_velocity"])
def test_the_kernel_equals_the_arrays(arm_and_plant, mode, interpreted):
    """The GPU kernel, interpreted, on a batch with a partial block."""
    arm, plant = arm_and_plant
    count, joints, periods, rng = 40, arm.embodiment.num_joints, 3, np.random.default_rng(0)
    draws = [draw_for(joints, seed) for seed in range(count)]
    batch = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(y, jnp.float32) for y in x]), *draws)
    home = np.asarray(arm.embodiment.home)
    qpos, qvel, *reference, torque = (0.1 * rng.normal(size=(6, count, joints))).astype(np.float32)
    state = LoopState(home + qpos, qvel, Reference(home + reference[0], *reference[1:]), torque)
    target = 0.1 * rng.normal(size=(count, joints))
    arguments = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (jax.vmap(plant.episode)(batch), state, target))
    kernel = gpu_kernel(mode, plant.constants, periods, LaunchConfig(block=32, warps=1))
    (actual,) = jax.jit(kernel)(*jax.vmap(flattened)(*arguments))
    expected = jax.jit(jax.vmap(make_inner_loop(mode, plant.constants, periods)))(*arguments)
    rows = np.moveaxis(np.asarray(actual).reshape(count, joints, 6), -1, 0)
    for values, reference in zip(rows, jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(values, reference, rtol=2e-4, atol=2e-4)  # float32, sums in another order


def test_the_kernel_lowers_without_a_gpu(arm_and_plant):
    arm, plant = arm_and_plant
    home, episode = start_of(arm, np.float32), plant.episode(draw_for(arm.embodiment.num_joints))
    batch = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x, jnp.float32)] * 2), (episode, home, home.qvel))
    assert "triton" in gpu_program(jax.jit(jax.vmap(make_inner_loop("joint_velocity", plant.constants, 2))), *batch)


def test_stops_hold_an_arm_that_is_driven_into_them(arm_and_plant):
    """At the maximum torque; a stop is a spring, which gives way a little."""
    arm, plant = arm_and_plant
    joints = arm.embodiment.num_joints
    draw = dataclasses.replace(draw_for(joints), gravity_error=jnp.asarray(0.0))
    torque = np.asarray(plant.constants.parameters.torque) * 0.3
    loop, state = jax.jit(make_inner_loop("torque", plant.constants, PERIODS)), start_of(arm, np.float32)
    target, episode = jnp.asarray(torque, jnp.float32), plant.episode(draw)
    for _ in range(60):
        state = loop(episode, state, target)
    beyond = np.asarray(state.qpos) - np.asarray(arm.embodiment.joint_range)[:, 1]
    assert np.all(np.abs(np.asarray(state.qvel)) < 0.1)
    assert beyond.max() > 0 and beyond.max() < 0.02
