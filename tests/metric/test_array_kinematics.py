"""Link states of any arm against C MuJoCo, as constants and as data of one function, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.arms.arrays import MAX_JOINTS, lock_joints
from mimic.arms.sampler import random_arm
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.kinematics import axes_and_origins, frame_table, link_state_table, link_states, states_in_frames
from mimic.retargeting.array_nearest import link_jacobians
from tests.helpers import random_arms
from tests.helpers.array_cases import Batch, random_source

# 1e-16 of each step from base to tip, times speeds of up to 30 rad/s; link lengths round at 1e-16 of a metre too.
ATOL = 1e-11


@pytest.fixture(scope="module")
def batch():
    """Two arms of each number of joints."""
    return Batch([random_source(seed) for seed in range(2 * MAX_JOINTS)])


@pytest.fixture(scope="module")
def states(batch):
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(link_states))(batch.arrays, batch.qpos, batch.qvel))


def test_link_states_are_those_of_mujoco(batch, states):
    for i, (source, arm, (qpos, qvel, *_)) in enumerate(zip(batch.sources, batch.arms, batch.motions, strict=True)):
        embodiment = arm.embodiment
        expected = random_arms.links(source, random_arms.posed(source, qpos, qvel), embodiment.link_names)
        constant = link_state_table(embodiment, qpos, qvel, float)
        for name, values in expected.items():
            unit = embodiment.chain_length if name in ("position", "linear_velocity") else 1.0
            for actual in (getattr(constant, name), getattr(states, name)[i, : embodiment.num_links]):
                np.testing.assert_allclose(unit * actual, values, rtol=0, atol=ATOL)


def test_empty_slots_of_links_rest_at_the_base(batch, states):
    for i, arm in enumerate(batch.arms):
        empty = slice(arm.embodiment.num_links, None)
        for name in ("position", "linear_velocity", "angular_velocity"):
            assert not getattr(states, name)[i, empty].any()
        np.testing.assert_array_equal(states.direction[i, empty], np.eye(3)[[0] * len(states.direction[i, empty])])


def test_axes_of_the_joints_are_those_of_the_embodiment(x64, batch):
    every = jax.jit(jax.vmap(lambda *x: axes_and_origins(frame_table(*x))))(batch.arrays, jnp.zeros_like(batch.qpos))
    for i, arm in enumerate(batch.arms):
        axes, origins = (x[i, : arm.embodiment.num_joints] for x in every)
        np.testing.assert_allclose(axes, arm.embodiment.joint_axis, atol=ATOL)
        moment_arms = np.cross(arm.embodiment.joint_anchor - origins, axes)  # 0 for a point on the axis
        np.testing.assert_allclose(moment_arms, 0, atol=ATOL)


def test_jacobians_are_the_derivatives_and_0_for_locked_joints(x64, batch):
    locked = np.arange(MAX_JOINTS) == 2
    arm = lock_joints(jax.tree.map(lambda x: x[-1], batch.arrays), locked)  # of 8 joints
    qpos = jnp.asarray(batch.qpos[-1])
    frames = frame_table(arm, qpos)
    actual = link_jacobians(arm, frames, states_in_frames(arm, frames))
    expected = jax.jit(jax.jacfwd(lambda qpos: link_states(arm, qpos)))(qpos)
    for jacobian, derivative in ((actual.position, expected.position), (actual.direction, expected.direction)):
        np.testing.assert_allclose(jacobian[~locked], np.moveaxis(derivative, -1, 0)[~locked], rtol=0, atol=ATOL)
        assert not np.any(jacobian[2]) and np.any(derivative[..., 2])


def test_correspondence_is_that_by_arc_length(x64, batch):
    """Up to the weights of empty slots: the mean over all pairs of slots is the mean over the pairs of links."""
    for i, j in ((3, 7), (12, 4), (5, 5)):
        expert, learner = (batch.arms[k].embodiment for k in (i, j))
        expected = np.asarray(mimic.arc_length_correspondence(expert, learner))
        arrays = [jax.tree.map(lambda x, k=k: x[k], batch.arrays) for k in (i, j)]
        actual = np.asarray(arc_length_correspondence(*arrays))
        own = actual[: expert.num_links, : learner.num_links]
        np.testing.assert_allclose(own / own.sum(), expected / expected.sum(), rtol=0, atol=ATOL)
        assert actual.mean() == pytest.approx(1.0)
        assert not actual[expert.num_links :].any() and not actual[:, learner.num_links :].any()


@pytest.mark.slow
def test_correspondence_of_drawn_arms_integrates_along_both_chains():
    """In single precision, of traced experts and learners, some without a link in the first slot: links by length."""
    drawn = jax.jit(jax.vmap(random_arm))(jax.random.split(jax.random.PRNGKey(1), 128))
    experts, learners = (jax.tree.map(lambda x, half=half: x[half], drawn) for half in (slice(64), slice(64, None)))
    matrix = np.asarray(jax.jit(jax.vmap(arc_length_correspondence))(experts, learners))
    shares = matrix / matrix.sum(axis=(1, 2), keepdims=True)
    for arms, axis in ((experts, 2), (learners, 1)):
        lengths = np.asarray(arms.link_length)
        assert (lengths[:, 0] == 0).any() and (lengths[:, 0] > 0).any()
        # Ends are sums of up to 9 lengths, and an overlap is a difference of them: 20 roundings of 6e-8 each.
        np.testing.assert_allclose(shares.sum(axis=axis), lengths / lengths.sum(1, keepdims=True), rtol=0, atol=2e-6)
        empty = np.moveaxis(matrix, axis, -1)[lengths == 0]
        assert not empty.any()
