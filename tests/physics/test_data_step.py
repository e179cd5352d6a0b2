"""Steps of any arm, and that its kernel lowers. `test_dynamics.py` has the equations against C MuJoCo."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, arm_arrays, stack_arms
from mimic.physics.composite_kernel import make_advance

TIMESTEP, SUBSTEPS, COUNT = 0.01, 10, 5
ARMS = {
    "panda": ArmConfig(),
    "panda5": ArmConfig(locked=[3, 6]),
    "planar": ArmConfig(model="planar", link_lengths=[0.4, 0.3, 0.2]),
}


ADVANCE = jax.jit(jax.vmap(make_advance(TIMESTEP, SUBSTEPS)))


def random_states(joints, dtype: Any = np.float64):
    """Angles, velocities and torques of light motion: each [count, joints]."""
    rng = np.random.default_rng(joints)
    factors = np.array([3.0, 2.0, 0.3])[:, None, None]
    return (factors * rng.uniform(-1, 1, (3, COUNT, joints))).astype(dtype)


def copies(arm, count=COUNT):
    return stack_arms([arm] * count)


@pytest.fixture(scope="module")
def mixed():
    """Arms of 2, 3, 5 and 7 joints and a locked Panda in one batch, in single precision."""
    arms = [arm_arrays(build_arm(config)) for config in ARMS.values()]
    arms += [arm_arrays(build_arm(ArmConfig()), np.array([1, 0, 1, 0, 1, 1, 0], bool).tolist())]
    arms += [arm_arrays(build_arm(ArmConfig(model="planar", link_lengths=[0.5, 0.5])))]
    arms = stack_arms(arms).astype(np.float32)
    qpos, qvel, torque = random_states(MAX_JOINTS, np.float32)
    return arms, qpos, qvel * arms.is_free, torque


def test_a_batch_steps_as_each_of_its_arms(mixed):
    together, alone = ADVANCE(*mixed), jax.jit(make_advance(TIMESTEP, SUBSTEPS))
    for i in range(COUNT):
        for batched, single in zip(together, alone(*jax.tree.map(lambda x, i=i: x[i], mixed)), strict=True):
            np.testing.assert_allclose(batched[i], single, atol=1e-5)  # rounding of velocities up to 10 rad/s


def test_locked_joints_and_empty_slots_rest_at_their_angle(mixed):
    arms, start, *_ = mixed
    qpos, qvel = ADVANCE(*mixed)
    rests = np.asarray(arms.is_free) == 0
    assert rests.any() and np.all(np.isfinite(qpos)) and np.all(np.isfinite(qvel))
    np.testing.assert_array_equal(np.asarray(qpos)[rests], start[rests])
    assert not np.asarray(qvel)[rests].any()
    assert np.all(np.asarray(qpos)[~rests] != start[~rests])


def test_some_arguments_may_be_common_to_the_batch(mixed):
    arms, qpos, qvel, torque = mixed
    advance = make_advance(TIMESTEP, SUBSTEPS)
    arm, state = jax.tree.map(lambda x: x[0], arms), (qpos, qvel * arms.is_free[0])
    common = jax.jit(jax.vmap(advance, (None, 0, 0, None)))(arm, *state, torque[0])
    each = ADVANCE(copies(arm), *state, np.tile(torque[:1], (COUNT, 1)))
    for a, b in zip(common, each, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_gradients_are_finite_and_those_of_finite_differences(x64, mixed):
    """Of each argument, for a batch: locked joints and empty slots give 0 and never NaN."""
    advance = make_advance(TIMESTEP, 3)
    arguments = jax.tree.map(lambda x: x.astype(np.float64) if x.dtype == np.float32 else x, mixed)

    def total(arguments):
        qpos, qvel = jax.vmap(advance)(*arguments)
        return jnp.sum(jnp.sin(qpos) + 0.1 * qvel)

    value_and_gradient = jax.jit(jax.value_and_grad(total, allow_int=True))
    gradient = value_and_gradient(arguments)[1]
    floats = [x for x in jax.tree.leaves(gradient) if x.dtype == np.float64]
    assert all(np.all(np.isfinite(x)) for x in floats)
    arms, gradient_of_arms = arguments[0], gradient[0]
    empty = np.arange(MAX_JOINTS) >= np.array([7, 5, 3, 7, 2])[:, None]
    for name in ("armature", "damping"):
        by_slot = np.asarray(getattr(gradient_of_arms, name))
        assert not by_slot[empty].any() and by_slot[arms.is_free == 1].all()
    rng, step = np.random.default_rng(0), 1e-6

    def moved(sign):
        torque, damping = arguments[3] + sign * step * d_torque, arms.damping + sign * step * d_damping
        changed = dataclasses.replace(arms, damping=damping)
        return value_and_gradient((changed, *arguments[1:3], torque))[0]

    d_torque, d_damping = rng.normal(size=(2, COUNT, MAX_JOINTS))
    expected = (moved(1) - moved(-1)) / (2 * step)
    actual = np.sum(gradient[3] * d_torque) + np.sum(gradient_of_arms.damping * d_damping)
    np.testing.assert_allclose(actual, expected, rtol=1e-6)  # 1e-16 / 1e-6, times a hundred, and the step squared
