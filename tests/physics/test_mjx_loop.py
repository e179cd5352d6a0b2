"""The inner loop on MJX against C MuJoCo: stops, and contacts of links with the floor and with each other."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mimic.arms.arm import build_arm
from mimic.arms.capsules import fit_capsules
from mimic.control.joint_control import Reference
from mimic.envs import env_config
from mimic.envs.world_env import plant_of
from mimic.metric.capsule_distances import colliding_pairs
from mimic.physics.inner_loop import LoopState
from mimic.physics.mjx_loop import make_mjx_loop
from mimic.physics.mujoco_world import mujoco_world
from tests.physics.test_inner_loop import PERIODS, draw_for, simulate_in_mujoco

TICKS = 12


def contacts(model, qpos):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data.ncon


@pytest.fixture(scope="module")
def case():
    config = env_config("panda4dof", world="nominal")
    arm = build_arm(config.learner, config.limits)
    plant, capsules = plant_of(config, arm), fit_capsules(config.learner, config.limits)
    assert config.world is not None
    world = mujoco_world(arm, config.world, capsules, colliding_pairs(arm.embodiment, capsules))
    draw = draw_for(arm.embodiment.num_joints)
    ones = jnp.ones(arm.embodiment.num_joints)
    nominal = {
        "link_mass": ones,
        "gain": ones,
        "bias": 0 * ones,
        "payload": jnp.zeros(()),
        "payload_lever": jnp.zeros(()),
    }
    draw = dataclasses.replace(draw, **nominal, gravity_error=jnp.zeros(()))
    draw = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), draw)
    return arm, plant, world, draw, jax.jit(make_mjx_loop("torque", plant, world, PERIODS))


@pytest.mark.slow_for("torque0-False", "torque1-True")
@pytest.mark.parametrize(
    ("torque", "touches"),
    [
        ([0.0, 0.0, 20.0, 0.0], False),  # the elbow into its stop
        ([0.0, 60.0, 20.0, 0.0], True),  # the hand onto the floor
        ([0.0, 12.0, -10.0, 0.0], True),  # the forearm onto the base
    ],
)
def test_stops_and_contacts_are_those_of_c_mujoco(case, torque, touches):
    """Up to what two solvers differ: MJX iterates in single precision and finds the points of a contact on its own."""
    arm, plant, world, draw, loop = case
    joints, home = arm.embodiment.num_joints, np.asarray(arm.embodiment.home)
    target = np.array(torque)
    model = world.model
    model.opt.gravity[:] = 0.0  # the draw has no error of the compensation
    expected = simulate_in_mujoco(model, home, plant, draw, "torque", [target] * TICKS)
    assert any(contacts(model, qpos) for qpos in expected) == touches
    lower, upper = np.asarray(arm.embodiment.joint_range).T
    assert touches or np.any((expected[-1] > upper - 0.01) | (expected[-1] < lower + 0.01))
    zero = jnp.zeros(joints)
    state = LoopState(jnp.asarray(home, jnp.float32), zero, Reference(jnp.asarray(home, jnp.float32), zero, zero), zero)
    rows, wanted = [], jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), target)
    for _ in range(TICKS):
        state = loop(draw, state, wanted)
        rows.append(state.qpos)
    assert np.abs(np.stack(rows) - expected).max() < 0.02  # rad
    assert np.abs(expected[-1] - home).max() > 0.2
