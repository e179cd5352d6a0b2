"""Distances of long arms: the GPU kernel that walks along both, interpreted on the CPU, beside the composition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import DTypeLike

from mimic import motion_distance
from mimic.arms.embodiment import in_chain_lengths, load_mjcf, panda, planar_arm
from mimic.metric import fused_kernel, long_chain_kernel
from mimic.metric import motion_distance as motion
from mimic.metric.correspondence import overlap_correspondence
from mimic.metric.distance import PAPER_WEIGHTS, DistanceWeights, embodiment_distance
from mimic.metric.kinematics import LONG, link_states
from tests.helpers.lowering import gpu_program
from tests.helpers.metric_cases import ALL_WEIGHTS
from tests.helpers.random_arms import random_arm

ARGUMENTS = (0, 1, 2, 3)
LONG_ARMS = planar_arm(np.linspace(0.1, 0.3, LONG + 3)), planar_arm(np.linspace(0.2, 0.1, 5))
SPARSE = np.zeros((7, 4))
SPARSE[[2, 2, 5], [0, 1, 1]] = 1.0, 0.5, 2.0  # links without a partner before, between and behind those that have one
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


def plan(arms, correspondence, weights):
    factors = motion._factors(np.asarray(correspondence, float), weights)
    return long_chain_kernel.plan([in_chain_lengths(arm) for arm in arms], factors)


def walk_of(*case):
    walk = plan(*case)
    assert walk is not None
    return walk


def motions(arms, batch, dtype: DTypeLike = np.float64):
    rng = np.random.default_rng(3)
    widths = [arm.num_joints for arm in arms for _ in range(2)]
    return [jnp.asarray(rng.uniform(-m, m, (batch, n)), dtype) for m, n in zip((np.pi, 2.0) * 2, widths, strict=True)]


def values_and_gradients(arms, correspondence, weights, batch):
    """Of the composition, as the kernel gives them."""

    def distance(*motion):
        states = link_states(arms[0], *motion[:2]), link_states(arms[1], *motion[2:])
        return embodiment_distance(*states, correspondence, weights)

    value, gradients = jax.jit(jax.vmap(jax.value_and_grad(distance, ARGUMENTS)))(*batch)
    return value[:, None], *gradients


@pytest.mark.usefixtures("x64", "interpreted")
@pytest.mark.parametrize("case", CASES)
def test_the_kernel_computes_what_the_composition_does(case):
    arms, correspondence, weights = CASES[case]
    correspondence = overlap_correspondence(*arms) if correspondence is None else correspondence
    batch = motions(arms, fused_kernel.DEFAULT.block + 1)  # the last block sticks out
    expected = values_and_gradients(arms, correspondence, weights, batch)
    walk = walk_of(arms, correspondence, weights)
    for wanted in ((), (2,), ARGUMENTS):
        found = jax.jit(long_chain_kernel.gpu_kernel(walk, wanted))(*batch)
        for values, reference in zip(found, [expected[0], *(expected[1 + k] for k in wanted)], strict=True):
            np.testing.assert_allclose(values, reference, atol=1e-13)  # rounding


@pytest.mark.usefixtures("x64", "interpreted")
def test_arms_of_any_shape_are_walked():
    arms = load_mjcf(random_arm(4, 9)), load_mjcf(random_arm(7, 6))
    metric = overlap_correspondence(*arms), ALL_WEIGHTS
    batch = motions(arms, 3)
    found = jax.jit(long_chain_kernel.gpu_kernel(walk_of(arms, *metric), ARGUMENTS))(*batch)
    for values, reference in zip(found, values_and_gradients(arms, *metric, batch), strict=True):
        np.testing.assert_allclose(values, reference, atol=1e-12)  # rounding, of velocities up to 20 chain lengths/s


def test_a_step_crosses_no_more_joints_than_it_must():
    arm = planar_arm(np.full(20, 0.1))
    alike = walk_of((arm, arm), np.eye(20), PAPER_WEIGHTS)
    assert len(alike.joints) == 20
    np.testing.assert_array_equal(alike.joints, np.repeat(np.arange(20)[:, None], 2, axis=1))
    overlap = overlap_correspondence(*LONG_ARMS)
    assert len(walk_of(LONG_ARMS, overlap, PAPER_WEIGHTS).joints) == np.count_nonzero(overlap)


@pytest.mark.usefixtures("interpreted")
def test_zero_with_gradients_of_zero_at_a_match():
    arm = panda()
    walk = walk_of((arm, arm), 2 * np.eye(7), ALL_WEIGHTS)
    qpos, qvel, *_ = motions((arm, arm), 2, np.float32)
    for motion_of_both in ((qpos, qvel), (qpos, 0 * qvel), (0 * qpos, 0 * qvel)):
        for values in long_chain_kernel.gpu_kernel(walk, ARGUMENTS)(*motion_of_both, *motion_of_both):
            assert np.all(np.abs(values) < 1e-6)  # rounding, where the two arms are rounded otherwise


def test_joints_beyond_the_last_pair_are_not_walked():
    walk = walk_of(CASES["few pairs"][0], SPARSE, PAPER_WEIGHTS)
    assert walk.joints.max(axis=0).tolist() == [5, 1]


@pytest.mark.parametrize("pairs", [[], [(0, 1)]], ids=["no pair", "a link fixed to the base"])
def test_nothing_is_walked_where_nothing_moves(x64, pairs):
    arms = panda(locked=(1,), links="kept"), LONG_ARMS[0]
    correspondence = np.zeros((7, LONG + 3))
    for pair in pairs:
        correspondence[pair] = 1.0
    assert plan(arms, correspondence, PAPER_WEIGHTS) is None
    batch = motions(arms, 2)
    value, gradients = jax.vmap(jax.value_and_grad(motion_distance(*arms, correspondence), ARGUMENTS))(*batch)
    expected = values_and_gradients(arms, correspondence, PAPER_WEIGHTS, batch)
    for values, reference in zip((value[:, None], *gradients), expected, strict=True):
        np.testing.assert_allclose(values, reference, atol=1e-13)  # rounding


def test_links_that_correspond_out_of_order_are_not_walked(x64):
    arms = LONG_ARMS
    crossed = np.zeros((LONG + 3, 5))
    crossed[[3, 6], [2, 1]] = 1.0
    assert plan(arms, crossed, PAPER_WEIGHTS) is None
    batch = motions(arms, 4)
    distance = jax.value_and_grad(motion_distance(*arms, crossed), ARGUMENTS)
    value, gradients = jax.jit(jax.vmap(distance))(*batch)
    for values, reference in zip(
        (value[:, None], *gradients), values_and_gradients(arms, crossed, PAPER_WEIGHTS, batch), strict=True
    ):
        np.testing.assert_allclose(values, reference, atol=1e-13)  # rounding


def test_distance_and_gradient_of_long_arms_are_one_kernel_on_a_gpu():
    distance = motion_distance(*LONG_ARMS, overlap_correspondence(*LONG_ARMS))
    batch = motions(LONG_ARMS, 5, np.float32)
    for function in (distance, jax.value_and_grad(distance, (2, 3)), jax.grad(distance, 0)):
        program = jax.jit(jax.vmap(function))
        assert gpu_program(program, *batch).count("triton") == 1
        assert "triton" not in program.lower(*batch).as_text()


def test_the_kernel_lowers_in_double_precision(x64):
    distance = motion_distance(*LONG_ARMS, overlap_correspondence(*LONG_ARMS))
    assert "triton" in gpu_program(jax.jit(jax.vmap(jax.grad(distance, 2))), *motions(LONG_ARMS, 5))


@pytest.mark.gpu
def test_the_gpu_computes_what_double_precision_does():
    arms = load_mjcf(random_arm(4, 40)), load_mjcf(random_arm(7, 20))
    metric = overlap_correspondence(*arms), PAPER_WEIGHTS
    batch = motions(arms, 10_001, np.float32)
    value, gradients = jax.jit(jax.vmap(jax.value_and_grad(motion_distance(*arms, *metric), ARGUMENTS)))(*batch)
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        expected = values_and_gradients(arms, *metric, [np.asarray(x, np.float64) for x in batch])
    for values, reference in zip((value[:, None], *gradients), expected, strict=True):
        np.testing.assert_allclose(values, reference, atol=1e-5)  # float32, there and back over 40 joints
