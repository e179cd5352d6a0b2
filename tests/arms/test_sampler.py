"""Distributions of arms."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mimic.arms import sampler
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, arm_arrays, stack_arms
from mimic.metric.kinematics import link_states
from mimic.physics.dynamics import inertia_matrix

COUNT = 200


@pytest.fixture(scope="module")
def panda():
    return arm_arrays(build_arm(ArmConfig()))


@pytest.fixture(scope="module")
def arms():
    return jax.jit(jax.vmap(sampler.random_arm))(jax.random.split(jax.random.PRNGKey(0), COUNT))


def test_masks_are_all_ways_to_lock_joints():
    masks = sampler.lock_masks(7, 2)
    assert len(masks) == 28 and len(np.unique(masks, axis=0)) == 28
    assert set(masks.sum(axis=1)) == {1, 2} and not masks[:, 7].any()
    fewer = sampler.lock_masks(7, 2, excluded=[(1,), (5, 1)])
    assert len(fewer) == 26 and not any(set(np.flatnonzero(x)) in ({0}, {0, 4}) for x in fewer)


def test_locked_variants_are_drawn_alike(panda):
    """The counts of 28 variants in 2800 draws deviate by 10 from 100; five deviations are allowed."""
    masks = sampler.lock_masks(7, 2)
    draw = jax.jit(jax.vmap(sampler.lock_sampler(panda, masks)))
    drawn = np.asarray(draw(jax.random.split(jax.random.PRNGKey(1), 2800)).is_free)
    counts = [(drawn == panda.is_free * (1 - mask)).all(axis=1).sum() for mask in masks]
    assert sum(counts) == 2800 and min(counts) > 50 and max(counts) < 150


@pytest.mark.slow
def test_a_mixture_draws_from_each_sampler(panda):
    locked = sampler.lock_sampler(panda, sampler.lock_masks(7, 1))
    draw = jax.jit(jax.vmap(sampler.mixed_sampler([locked, sampler.random_arm], [0.25, 0.75])))
    lengths = np.asarray(draw(jax.random.split(jax.random.PRNGKey(3), 400)).chain_length)
    share = np.isclose(lengths, panda.chain_length, rtol=1e-6).mean()
    assert 0.15 < share < 0.35  # five deviations of 0.02


@pytest.fixture(scope="module")
def perturbed(panda):
    """Pandas of 1.2 times the size and 1.5 times the mass, with the drives of the model."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampler, "_SIZE", (1.2, 1.2))
        patch.setattr(sampler, "_MASS", (1.5, 1.5))
        patch.setattr(sampler, "_DRIVES", ((1.0, 1.0),) * 3)
        return jax.jit(jax.vmap(sampler.perturbed_sampler([panda])))(jax.random.split(jax.random.PRNGKey(5), 40))


def test_perturbed_arms_have_the_same_shape_about_the_vertical(panda, perturbed):
    """Link states are relative to the chain length; only the base rotates."""
    np.testing.assert_allclose(perturbed.chain_length, 1.2 * panda.chain_length, rtol=1e-5)
    qpos = jnp.asarray([0.3, -0.5, 0.7, -1.2, 0.4, 1.1, -0.6, 0.0])
    of_arms = jax.jit(jax.vmap(link_states, (0, None)))
    own, theirs = jax.tree.map(lambda x: x[0], of_arms(stack_arms([panda]), qpos)), of_arms(perturbed, qpos)
    for part in ("position", "direction"):
        vectors, expected = np.asarray(getattr(theirs, part)), np.asarray(getattr(own, part))
        np.testing.assert_allclose(vectors[..., 2], np.tile(expected[:, 2], (40, 1)), atol=1e-5)
        gram = np.einsum("alx,amx->alm", vectors, vectors)
        np.testing.assert_allclose(gram, np.tile(expected @ expected.T, (40, 1, 1)), atol=1e-5)


def test_perturbed_inertia_is_that_of_scaled_bodies(panda, perturbed):
    """Times the mass and the square of the size, without the rotors; three in ten arms have a joint locked."""
    qpos = jnp.asarray([0.3, -0.5, 0.7, -1.2, 0.4, 1.1, -0.6, 0.0])
    whole = np.asarray(perturbed.is_free).sum(axis=1) == 7
    assert 0.5 < whole.mean() < 0.95 and np.asarray(perturbed.is_free).sum(axis=1).min() == 6
    of_arms = jax.jit(jax.vmap(inertia_matrix, (0, None)))
    matrices = np.asarray(of_arms(perturbed, qpos))[whole][:, :7, :7]
    own = np.asarray(of_arms(stack_arms([panda]), qpos))[0, :7, :7] - np.diag(panda.armature[:7])
    expected = 1.5 * 1.2**2 * own + np.diag(panda.armature[:7])
    np.testing.assert_allclose(matrices, np.tile(expected, (len(matrices), 1, 1)), rtol=1e-4, atol=1e-4)


def test_random_arms_are_chains_of_connected_links(arms):
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(arms))
    assert set(np.asarray(arms.is_free.sum(axis=1))) == {4, 5, 6, 7, 8}
    qpos = jax.random.uniform(jax.random.PRNGKey(4), (COUNT, MAX_JOINTS), minval=-3, maxval=3) * arms.is_free
    arms = jax.tree.map(np.asarray, arms)
    states = jax.tree.map(np.asarray, jax.jit(jax.vmap(link_states))(arms, qpos))
    lengths = arms.link_length / arms.chain_length[:, None]
    assert states.direction is not None
    half = 0.5 * states.direction * lengths[..., None]
    jumps = np.linalg.norm((states.position + half)[:, :-1] - (states.position - half)[:, 1:], axis=-1)
    # A base without a link is a link of length 0 before the first; empty slots come after the last one.
    both = np.asarray((lengths[:, 1:] > 0) & ((lengths[:, :-1] > 0) | (np.arange(11) == 0)))
    assert jumps[both].max() < 1e-5  # chain lengths; single precision over 8 rotations


def test_random_arms_have_positive_inertia(arms):
    """At least that of the rotors in each direction."""
    qpos = jax.random.uniform(jax.random.PRNGKey(5), (COUNT, MAX_JOINTS), minval=-3, maxval=3)
    matrices = np.asarray(jax.jit(jax.vmap(inertia_matrix))(arms, qpos), float)
    assert np.linalg.eigvalsh(matrices).min() > 0.9 * float(arms.armature.min())


def test_a_body_is_a_cylinder_with_a_sphere(x64):
    radius, density, housing, length = 0.05, 2000.0, 1.5, 0.3
    sphere = housing / (4 / 3 * np.pi * radius**3)
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody><body><joint/>
      <geom type="cylinder" fromto="0 0 0 0 0 {length}" size="{radius}" density="{density}"/>
      <geom type="sphere" pos="0 0 {length}" size="{radius}" density="{sphere}"/></body></worldbody></mujoco>""")
    moments = jax.jit(sampler._rod_with_sphere)(np.array([0.0, 0.0, length]), radius, density, housing)
    mass, centre = model.body_mass[1], model.body_ipos[1]
    assert moments[3, 3] == pytest.approx(mass)
    np.testing.assert_allclose(moments[:3, 3], mass * centre, rtol=1e-12)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[1])
    inertia = rotation.reshape(3, 3) @ np.diag(model.body_inertia[1]) @ rotation.reshape(3, 3).T
    second = np.asarray(moments[:3, :3]) - mass * np.outer(centre, centre)
    np.testing.assert_allclose(np.trace(second) * np.eye(3) - second, inertia, rtol=0, atol=1e-12)
