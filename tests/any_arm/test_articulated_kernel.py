"""The GPU kernel of any arm, interpreted on the CPU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.any_arm.arrays import MAX_JOINTS, lock_joints
from mimic.any_arm.articulated_kernel import gpu_kernel
from mimic.any_arm.dynamics import joint_numbers
from mimic.any_arm.physics import make_advance
from mimic.envs.physics import Load
from mimic.metric.fused_kernel import LaunchConfig
from tests.any_arm.cases import Batch, random_source

TIMESTEP, SUBSTEPS = 0.005, 2
COUNT = 40  # of arms: one full block of 32 and a partial one
LAUNCHES = [LaunchConfig(block=32, warps=1, sample_axis=axis) for axis in (0, 1)]


@pytest.fixture(scope="module")
def batch():
    """Random arms of 1 to 8 joints, a third of which are locked, in light motion, and the load of each."""
    with jax.enable_x64(True):
        batch, rng = Batch([random_source(seed) for seed in range(COUNT)]), np.random.default_rng(0)
        arms = jax.vmap(lock_joints)(batch.arrays, rng.random((COUNT, MAX_JOINTS)) < 1 / 3)
        arms = jax.tree.map(np.asarray, arms)
        is_free = arms.is_free
        torque, load = rng.normal(size=(COUNT, MAX_JOINTS)), rng.uniform(0.5, 2, (2, COUNT))
        return arms, batch.qpos, 0.3 * batch.qvel * is_free, 0.3 * torque, Load(*load)


@pytest.mark.parametrize(("launch", "unroll"), [(LAUNCHES[0], 1), (LAUNCHES[1], 1), (LAUNCHES[1], 2)])
def test_the_kernel_equals_the_looped_form(x64, interpreted, batch, launch, unroll):
    arms, qpos, qvel, torque, load = batch
    empty = np.asarray(arms.is_free).sum(axis=1) < MAX_JOINTS
    assert empty.any() and (arms.is_free[:, 0] == 0).any()
    kernel = gpu_kernel(TIMESTEP, SUBSTEPS, launch=launch, unroll=unroll)
    numbers = jax.vmap(joint_numbers)(arms)
    actual = jax.jit(kernel)(numbers, *map(jnp.asarray, (qpos, qvel, torque)), jnp.stack(load, axis=1))
    expected = jax.jit(jax.vmap(make_advance(TIMESTEP, SUBSTEPS)))(*batch)
    for values, reference in zip(actual, expected, strict=True):
        scale = 1 + np.abs(reference).max(axis=1, keepdims=True)
        # Rounding of 1e-16, amplified by bodies much lighter than others.
        np.testing.assert_allclose(values / scale, reference / scale, rtol=0, atol=1e-10)
    assert not np.asarray(actual[1])[arms.is_free == 0].any()
