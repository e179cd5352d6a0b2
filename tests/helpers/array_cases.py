"""Random serial arms with random masses, their arrays, and their accelerations by C MuJoCo."""

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from mimic.arms.arm import Arm
from mimic.arms.arrays import MAX_JOINTS, arm_arrays, stack_arms
from mimic.arms.embodiment import load_arm
from mimic.arms.mujoco_chain import base_pose
from mimic.arms.simulation_model import simulation_model
from mimic.physics import dynamics, looped_dynamics
from mimic.physics.joint_numbers import NUMBERS, joint_numbers, unpacked
from mimic.physics.trigonometry import cosine_and_sine
from tests.helpers.random_arms import random_arm

# Double precision leaves 1e-16 of each of a few thousand operations, and bodies much lighter than others amplify it.
RTOL = 1e-9


def arm_of(source):
    """The arm of a model, which then has neither gravity nor contacts itself."""
    embodiment, source, angles = load_arm(source)
    arm = Arm(embodiment, simulation_model(source, embodiment.joint_names, angles), angles, base_pose(source))
    source.opt.disableflags = arm.model.opt.disableflags
    return arm


def random_source(seed):
    """A serial arm of 1 to 8 joints with random masses, inertias, centres of mass, armature and damping."""
    source = random_arm(seed, 1 + seed % MAX_JOINTS)
    rng = np.random.default_rng(seed)
    source.body_mass[1:] = rng.uniform(0.1, 3, source.nbody - 1)
    # Moments of a box, so that no one exceeds the sum of the others; of bodies of 3 to 30 cm.
    squares = rng.uniform(0.03, 0.3, (source.nbody - 1, 3)) ** 2
    source.body_inertia[1:] = source.body_mass[1:, None] / 12 * (squares.sum(axis=1, keepdims=True) - squares)
    source.body_ipos[1:] = rng.uniform(-0.1, 0.1, (source.nbody - 1, 3))
    quaternions = rng.normal(size=(source.nbody - 1, 4))
    source.body_iquat[1:] = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    source.dof_armature[:], source.dof_damping[:] = rng.uniform(0, 0.1, (2, source.nv))
    mujoco.mj_setConst(source, mujoco.MjData(source))
    return source


def random_motion(arm, rng):
    """Angles, velocities, accelerations, and the torques of these by C MuJoCo."""
    model = arm.model
    data = mujoco.MjData(model)
    data.qpos[:] = rng.uniform(-np.pi, np.pi, model.nq)
    data.qvel[:], data.qacc[:] = 3 * rng.normal(size=(2, model.nv))
    mujoco.mj_inverse(model, data)
    return tuple(x.copy() for x in (data.qpos, data.qvel, data.qacc, data.qfrc_inverse))


def acceleration(model, qpos, qvel, torque):
    """By C MuJoCo."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = qpos, qvel, torque
    mujoco.mj_forward(model, data)
    return data.qacc.copy()


def looped(arm, qpos, qvel, torque, base: Any = None):
    """Accelerations of an arm by the equations for CPUs."""
    numbers = joint_numbers(arm).reshape(MAX_JOINTS, NUMBERS)
    return looped_dynamics.acceleration(numbers, qpos, qvel, torque, base)


def unrolled(arm, qpos, qvel, torque, base: Any = None):
    """Accelerations of an arm by the equations of the GPU kernel."""
    joints = dynamics.with_locks(unpacked(joint_numbers(arm)))
    state = tuple(qpos), tuple(qvel), tuple(torque)
    return jnp.stack(dynamics.acceleration(joints, *state, base, cosine_and_sine))


def torque_of_arm(arm, qpos, qvel, qacc):
    """Inverse dynamics of an arm as data; 0 for locked joints."""
    joints = unpacked(joint_numbers(arm))
    return arm.is_free * jnp.stack(dynamics.inverse(joints, list(qpos), list(qvel), list(arm.is_free * qacc)))


def padded(values) -> Any:
    """Values of an arm's own joints, with 0 for the empty slots."""
    return np.pad(values, (0, MAX_JOINTS - len(values)))


class Batch:
    """Arms with a motion of each: `arrays`, and `qpos`, `qvel`, `qacc` and `torque`, each [arms, joints]."""

    def __init__(self, sources):
        rng = np.random.default_rng(0)
        self.sources = sources
        self.arms = [arm_of(source) for source in sources]
        self.arrays = stack_arms([arm_arrays(arm) for arm in self.arms])
        self.motions = [random_motion(arm, rng) for arm in self.arms]
        columns = zip(*self.motions, strict=True)
        self.qpos, self.qvel, self.qacc, self.torque = (np.stack([padded(x) for x in column]) for column in columns)


def assert_near(actual, expected, rtol=RTOL):
    """Within `rtol` of the largest entry of each row: an entry that happens to be small is the difference of others."""
    scale = np.abs(expected).max(axis=-1, keepdims=True)
    np.testing.assert_allclose(actual / scale, expected / scale, rtol=0, atol=rtol)
