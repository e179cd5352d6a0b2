"""The unrolled GPU kernel of any arm, interpreted on the CPU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.any_arm import composite_kernel, trigonometry
from mimic.any_arm.arrays import MAX_JOINTS
from mimic.any_arm.dynamics import joint_numbers
from mimic.any_arm.physics import make_advance
from mimic.metric.fused_kernel import LaunchConfig
from tests.any_arm.test_articulated_kernel import SUBSTEPS, TIMESTEP, batch  # noqa: F401
from tests.helpers.lowering import gpu_program

LAUNCHES = [LaunchConfig(block=32, warps=1, sample_axis=axis) for axis in (0, 1)]
FORMS = [
    composite_kernel.Form(is_interleaved=True),
    composite_kernel.Form(is_interleaved=False),
    composite_kernel.Form(rows_in_loops=False),
]


@pytest.mark.parametrize(("launch", "form"), [(LAUNCHES[0], FORMS[0]), *((LAUNCHES[1], form) for form in FORMS)])
def test_the_kernel_equals_the_looped_form(x64, interpreted, batch, launch, form):  # noqa: F811
    arms, qpos, qvel, torque, load = batch
    assert (np.asarray(arms.is_free).sum(axis=1) < MAX_JOINTS).any() and (arms.is_free[:, 0] == 0).any()
    kernel = composite_kernel.gpu_kernel(TIMESTEP, SUBSTEPS, launch=launch, form=form)
    actual = jax.jit(kernel)(jax.vmap(joint_numbers)(arms), *map(jnp.asarray, (qpos, qvel, torque)), np.stack(load, 1))
    expected = jax.jit(jax.vmap(make_advance(TIMESTEP, SUBSTEPS)))(*batch)
    for values, reference in zip(actual, expected, strict=True):
        scale = 1 + np.abs(reference).max(axis=1, keepdims=True)
        # Rounding of 1e-16, amplified by bodies much lighter than others.
        np.testing.assert_allclose(values / scale, reference / scale, rtol=0, atol=1e-10)
    rests = arms.is_free == 0
    np.testing.assert_array_equal(np.asarray(actual[0])[rests], np.asarray(qpos)[rests])
    assert not np.asarray(actual[1])[rests].any()


def test_single_precision(interpreted, batch):  # noqa: F811
    """With polynomials for cosines and sines, against double precision."""
    with jax.enable_x64(True):
        expected = jax.jit(jax.vmap(make_advance(TIMESTEP, SUBSTEPS)))(*batch)
    arms, qpos, qvel, torque, load = jax.tree.map(lambda x: np.asarray(x, np.float32), batch)
    kernel = composite_kernel.gpu_kernel(TIMESTEP, SUBSTEPS, launch=LAUNCHES[1])
    actual = jax.jit(kernel)(jax.vmap(joint_numbers)(arms), qpos, qvel, torque, np.stack(load, 1))
    for values, reference in zip(actual, expected, strict=True):
        scale = 1 + np.abs(reference).max(axis=1, keepdims=True)
        np.testing.assert_allclose(values / scale, reference / scale, rtol=0, atol=1e-3)


def test_forms_for_gpus_alone_lower(batch):  # noqa: F811
    """They use instructions that the CPU lacks."""
    form = composite_kernel.Form("hardware", reciprocal="hardware", has_barriers=True)
    arms, *states, load = jax.tree.map(lambda x: np.asarray(x, np.float32), batch)
    kernel = jax.jit(composite_kernel.gpu_kernel(TIMESTEP, SUBSTEPS, form=form))
    assert "triton" in gpu_program(kernel, jax.vmap(joint_numbers)(arms), *states, np.stack(load, 1))


@pytest.mark.parametrize("largest", [4.0, 1e3, 1e5])
def test_polynomials(largest):
    angle = np.random.default_rng(0).uniform(-largest, largest, 100_000).astype(np.float32)
    angle[:9] = np.pi / 2 * np.arange(-4, 5)
    actual = jax.jit(trigonometry.polynomial)(angle)
    exact = angle.astype(np.float64)
    for values, reference in zip(actual, (np.cos(exact), np.sin(exact)), strict=True):
        np.testing.assert_allclose(values, reference, rtol=0, atol=1.5e-7)
