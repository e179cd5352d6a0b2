"""Distances of long arms: the GPU kernel that loops over their links, interpreted on the CPU, and the composition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import DTypeLike

from mimic import motion_distance
from mimic.arms.embodiment import load_mjcf, panda, planar_arm
from mimic.base import fused_kernel
from mimic.metric import long_chain_kernel
from mimic.metric import motion_distance as motion_module
from mimic.metric.correspondence import overlap_correspondence
from mimic.metric.distance import PAPER_WEIGHTS, PARTS, DistanceWeights, embodiment_distance
from mimic.metric.kinematics import LONG, link_states
from tests.helpers.metric_cases import ALL_WEIGHTS
from tests.helpers.random_arms import random_arm

ARGUMENTS = (0, 1, 2, 3)
LONG_ARMS = planar_arm(np.linspace(0.1, 0.3, LONG + 3)), planar_arm(np.linspace(0.2, 0.1, 5))
SPARSE = np.zeros((7, 4))
SPARSE[[2, 2, 5], [0, 1, 1]] = 1.0, 0.5, 2.0  # links without a partner before, between and beyond those with one
SWAPPED = np.zeros((7, 7))
SWAPPED[[2, 3], [3, 2]] = 1.0, 2.0  # the expert's links 2 and 3 are on one joint
CASES = {
    "7 joints, 4": ((panda(), panda(locked=(3, 6, 7))), None, PAPER_WEIGHTS),
    # Links 1 of the locked arms are fixed to the base.
    "fixed links": (
        (panda(locked=(1,), links="kept"), panda(locked=(1, 4), links="kept")),
        None,
        ALL_WEIGHTS,
    ),
    "few pairs": ((panda(), panda(locked=(3, 6, 7), links="merged")), SPARSE, ALL_WEIGHTS),
    "links swapped": ((panda(locked=(1, 4), links="kept"), panda()), SWAPPED, PAPER_WEIGHTS),
    "long and short": (LONG_ARMS, None, ALL_WEIGHTS),
    "rotation alone": (LONG_ARMS, None, DistanceWeights(rotation=1.0)),
}
QUICK = "fixed links", "few pairs", "rotation alone"


@pytest.fixture
def long_kernel(gpu_kernels, monkeypatch):
    """Makes `motion_distance` use the kernel for long arms with any arms; returns the list of kernels used."""
    monkeypatch.setattr(motion_module, "LONG", 0)
    return gpu_kernels


def schedule(arms, correspondence, weights):
    """The joints that the kernel crosses and the links that it compares in each step, for arms of any size."""
    matrix = np.asarray(correspondence, float)
    return long_chain_kernel.plan(arms, np.stack([np.full(matrix.shape, getattr(weights, p)) for p in PARTS]) * matrix)


def joints_crossed(*case):
    planned = schedule(*case)
    assert planned is not None
    return planned.joints


def motions(arms, batch, dtype: DTypeLike = np.float64):
    rng = np.random.default_rng(3)
    widths = [arm.num_joints for arm in arms for _ in range(2)]
    return [jnp.asarray(rng.uniform(-m, m, (batch, n)), dtype) for m, n in zip((np.pi, 2.0) * 2, widths, strict=True)]


def values_and_gradients(arms, correspondence, weights, batch):
    """Value and gradients of the composition."""

    def distance(*motion):
        states = link_states(arms[0], *motion[:2]), link_states(arms[1], *motion[2:])
        return embodiment_distance(*states, correspondence, weights)

    value, gradients = jax.jit(jax.vmap(jax.value_and_grad(distance, ARGUMENTS)))(*batch)
    return value, *gradients


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=() if case in QUICK else pytest.mark.slow) for case in CASES]
)
def test_the_kernel_equals_the_composition(x64, long_kernel, case):
    arms, correspondence, weights = CASES[case]
    correspondence = overlap_correspondence(*arms) if correspondence is None else correspondence
    batch = motions(arms, fused_kernel.DEFAULT.block + 1)  # the last block is partial
    value, *gradients = values_and_gradients(arms, correspondence, weights, batch)
    distance = motion_distance(arms[0], arms[1], correspondence, weights)
    actual: list = [jax.jit(jax.vmap(distance))(*batch)]
    expected = [value]
    for by in ((2,), ARGUMENTS):
        actual += jax.tree.leaves(jax.jit(jax.vmap(jax.value_and_grad(distance, by)))(*batch))
        expected += [value, *(gradients[k] for k in by)]
    assert len(long_kernel) == 3
    for values, reference in zip(actual, expected, strict=True):
        np.testing.assert_allclose(values, reference, atol=1e-13)  # rounding


@pytest.mark.slow
def test_the_kernel_takes_arms_of_any_shape(x64, long_kernel):
    arms = load_mjcf(random_arm(4, 9)), load_mjcf(random_arm(7, 6))
    metric = overlap_correspondence(*arms), ALL_WEIGHTS
    batch = motions(arms, 3)
    value, gradients = jax.jit(jax.vmap(jax.value_and_grad(motion_distance(*arms, *metric), ARGUMENTS)))(*batch)
    assert long_kernel
    for values, reference in zip((value, *gradients), values_and_gradients(arms, *metric, batch), strict=True):
        np.testing.assert_allclose(values, reference, atol=1e-12)  # rounding, of velocities up to 20 chain lengths/s


def test_a_step_crosses_no_more_joints_than_it_must():
    arm = planar_arm(np.full(20, 0.1))
    alike = joints_crossed((arm, arm), np.eye(20), PAPER_WEIGHTS)
    np.testing.assert_array_equal(alike, np.repeat(np.arange(20)[:, None], 2, axis=1))
    overlap = overlap_correspondence(*LONG_ARMS)
    assert len(joints_crossed(LONG_ARMS, overlap, PAPER_WEIGHTS)) == np.count_nonzero(overlap)


@pytest.mark.slow
def test_the_kernel_gives_zero_with_gradients_of_zero_at_a_match(long_kernel):
    arm = panda()
    distance = jax.vmap(jax.value_and_grad(motion_distance(arm, arm, 2 * np.eye(7), ALL_WEIGHTS), ARGUMENTS))
    qpos, qvel, *_ = motions((arm, arm), 2, np.float32)
    for of_both in ((qpos, qvel), (qpos, 0 * qvel), (0 * qpos, 0 * qvel)):
        for values in jax.tree.leaves(distance(*of_both, *of_both)):
            assert np.all(np.abs(values) < 1e-6)  # rounding, where the two arms are rounded otherwise
    assert long_kernel


def test_joints_beyond_the_last_pair_are_not_crossed():
    assert joints_crossed(CASES["few pairs"][0], SPARSE, PAPER_WEIGHTS).max(axis=0).tolist() == [5, 1]


@pytest.mark.parametrize("pairs", [[], [(0, 1)]], ids=["no pair", "a link fixed to the base"])
def test_there_is_no_kernel_where_nothing_moves(x64, pairs):
    arms = panda(locked=(1,), links="kept"), LONG_ARMS[0]
    correspondence = np.zeros((7, LONG + 3))
    for pair in pairs:
        correspondence[pair] = 1.0
    assert schedule(arms, correspondence, PAPER_WEIGHTS) is None
    batch = motions(arms, 2)
    value, gradients = jax.vmap(jax.value_and_grad(motion_distance(*arms, correspondence), ARGUMENTS))(*batch)
    expected = values_and_gradients(arms, correspondence, PAPER_WEIGHTS, batch)
    for values, reference in zip((value, *gradients), expected, strict=True):
        np.testing.assert_allclose(values, reference, atol=1e-13)  # rounding


def test_there_is_no_kernel_for_links_that_correspond_out_of_order(x64):
    arms = LONG_ARMS
    crossed = np.zeros((LONG + 3, 5))
    crossed[[3, 6], [2, 1]] = 1.0
    assert schedule(arms, crossed, PAPER_WEIGHTS) is None
    batch = motions(arms, 4)
    distance = jax.value_and_grad(motion_distance(*arms, crossed), ARGUMENTS)
    value, gradients = jax.jit(jax.vmap(distance))(*batch)
    for values, reference in zip(
        (value, *gradients), values_and_gradients(arms, crossed, PAPER_WEIGHTS, batch), strict=True
    ):
        np.testing.assert_allclose(values, reference, atol=1e-13)  # rounding
