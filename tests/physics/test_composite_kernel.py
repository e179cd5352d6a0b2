"""The GPU kernel of any arm, interpreted on the CPU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.arrays import MAX_JOINTS, lock_joints
from mimic.base.fused_kernel import LaunchConfig
from mimic.physics.composite_kernel import gpu_kernel, make_advance
from mimic.physics.joint_numbers import joint_numbers
from mimic.physics.trigonometry import cosine_and_sine
from tests.helpers.array_cases import Batch, random_source

TIMESTEP, SUBSTEPS = 0.005, 2
COUNT = 40  # of arms: one full block of 32 and a partial one
LAUNCH = LaunchConfig(block=32, warps=1)


@pytest.fixture(scope="module")
def batch():
    """Random arms of 1 to 8 joints, a third of which are locked, in light motion."""
    with jax.enable_x64(True):
        batch, rng = Batch([random_source(seed) for seed in range(COUNT)]), np.random.default_rng(0)
        arms = jax.vmap(lock_joints)(batch.arrays, rng.random((COUNT, MAX_JOINTS)) < 1 / 3)
        arms = jax.tree.map(np.asarray, arms)
        is_free = arms.is_free
        return arms, batch.qpos, 0.3 * batch.qvel * is_free, 0.3 * rng.normal(size=(COUNT, MAX_JOINTS))


@pytest.mark.slow
def test_the_kernel_equals_the_looped_form(x64, interpreted, batch):
    arms, qpos, qvel, torque = batch
    assert (np.asarray(arms.is_free).sum(axis=1) < MAX_JOINTS).any() and (arms.is_free[:, 0] == 0).any()
    kernel = jax.jit(gpu_kernel(TIMESTEP, SUBSTEPS, launch=LAUNCH))
    actual = kernel(jax.vmap(joint_numbers)(arms), *map(jnp.asarray, (qpos, qvel, torque)))
    expected = jax.jit(jax.vmap(make_advance(TIMESTEP, SUBSTEPS)))(*batch)
    for values, reference in zip(actual, expected, strict=True):
        scale = 1 + np.abs(reference).max(axis=1, keepdims=True)
        # Rounding of 1e-16, amplified by bodies much lighter than others.
        np.testing.assert_allclose(values / scale, reference / scale, rtol=0, atol=1e-10)
    rests = arms.is_free == 0
    np.testing.assert_array_equal(np.asarray(actual[0])[rests], np.asarray(qpos)[rests])
    assert not np.asarray(actual[1])[rests].any()


@pytest.mark.parametrize("largest", [4.0, 1e3, 1e5])
def test_polynomials(largest):
    angle = np.random.default_rng(0).uniform(-largest, largest, 100_000).astype(np.float32)
    angle[:9] = np.pi / 2 * np.arange(-4, 5)
    actual = jax.jit(cosine_and_sine)(angle)
    exact = angle.astype(np.float64)
    for values, reference in zip(actual, (np.cos(exact), np.sin(exact)), strict=True):
        np.testing.assert_allclose(values, reference, rtol=0, atol=1.5e-7)
