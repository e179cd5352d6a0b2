import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import DTypeLike

from mimic import motion_distance
from mimic.arms.embodiment import LONG, load_mjcf, panda, planar_arm
from mimic.base import fused_kernel
from mimic.metric.correspondence import hard_correspondence, overlap_correspondence
from mimic.metric.distance import PAPER_WEIGHTS, DistanceWeights, embodiment_distance
from mimic.metric.kinematics import link_states
from tests.helpers.lowering import gpu_program
from tests.helpers.metric_cases import ALL_WEIGHTS, CORRESPONDENCES, EXPERT, LEARNER
from tests.helpers.random_arms import random_arm

PAIRS = {
    "planar": (EXPERT, LEARNER),
    "random": (load_mjcf(random_arm(2)), load_mjcf(random_arm(1))),
    # Links 1 of the locked arms are fixed to the base.
    "fixed links": (panda(locked=(1,), links="kept"), panda(locked=(1, 4), links="kept")),
}
EVERY_WEIGHT = {"paper": PAPER_WEIGHTS, "static": DistanceWeights(rotation=1.0), "all": ALL_WEIGHTS}
ALL_ARGUMENTS = (0, 1, 2, 3)


def composed(arms, correspondence, weights, **options):
    """The composition of functions that `motion_distance` equals; for long arms it is this composition."""

    def distance(*motion):
        states = link_states(arms[0], *motion[:2]), link_states(arms[1], *motion[2:])
        return embodiment_distance(*states, correspondence, weights, **options)

    return distance


def motions(arms, batch=5, dtype: DTypeLike = np.float64):
    rng = np.random.default_rng(3)
    largest = (np.pi, 2.0) * 2
    joints = [arm.num_joints for arm in arms for _ in range(2)]
    return [jnp.asarray(rng.uniform(-m, m, (batch, n)), dtype) for m, n in zip(largest, joints, strict=True)]


def largest_difference(actual, expected):
    pairs = zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True)
    return max(float(np.abs(np.asarray(a, float) - np.asarray(b, float)).max()) for a, b in pairs)


@pytest.mark.slow_for("fixed links-all")
@pytest.mark.parametrize(("pair", "weights"), [("random", "static"), ("planar", "all"), ("fixed links", "all")])
def test_value_and_gradient_equal_those_of_the_composition(x64, pair, weights):
    arms = PAIRS[pair]
    metric = overlap_correspondence(*arms), EVERY_WEIGHT[weights]
    functions = motion_distance(*arms, *metric), composed(arms, *metric)
    actual, expected = (jax.jit(jax.vmap(jax.value_and_grad(f, ALL_ARGUMENTS)))(*motions(arms)) for f in functions)
    assert largest_difference(actual, expected) < 1e-13  # rounding
    assert float(np.abs(expected[1][2]).max()) > 1e-2


def test_other_metrics_equal_the_composition(x64):
    metric, arms = (CORRESPONDENCES["overlap"], ALL_WEIGHTS), (EXPERT, LEARNER)
    sample = [x[0] for x in motions(arms)]
    several: tuple[dict, ...] = {}, {"rotation": "angle"}, {"reduction": "frobenius"}
    for options in several:
        functions = motion_distance(*arms, *metric, **options), composed(arms, *metric, **options)
        actual, expected = (jax.jit(function)(*sample) for function in functions)
        np.testing.assert_allclose(actual, expected, rtol=1e-13)  # rounding


@pytest.mark.slow
def test_all_ways_to_differentiate_agree(x64):
    """Forward, reverse, within and around `vmap`, by any of the arguments, and twice."""
    arms = EXPERT, LEARNER
    metric = overlap_correspondence(*arms), ALL_WEIGHTS
    distance, plain = motion_distance(*arms, *metric), composed(arms, *metric)
    batch = motions(arms)
    for by in ((0,), (2,), (3, 1)):
        expected = jax.jit(jax.vmap(jax.grad(plain, by)))(*batch)
        for gradient in (
            jax.vmap(jax.grad(distance, by)),
            jax.grad(lambda *x: jax.vmap(distance)(*x).sum(), by),
            jax.grad(lambda *x: jax.jit(jax.vmap(distance))(*x).sum(), by),
            jax.vmap(jax.jacfwd(distance, by)),
        ):
            assert largest_difference(jax.jit(gradient)(*batch), expected) < 1e-13
    for twice in (jax.hessian, lambda f, by: jax.jacrev(jax.grad(f, by), by)):
        second = [jax.jit(jax.vmap(twice(f, 2)))(*batch) for f in (distance, plain)]
        assert largest_difference(*second) < 1e-12  # two derivatives, and a division by lengths of 0.1


def test_one_expert_pose_serves_a_batch_of_learners():
    arms = EXPERT, LEARNER
    distance = motion_distance(*arms, overlap_correspondence(*arms))
    qpos, qvel, *learner = motions(arms, dtype=np.float32)
    one = jax.vmap(distance, in_axes=(None, None, 0, 0))
    actual = jax.jit(one)(qpos[0], qvel[0], *learner)
    every = jax.jit(jax.vmap(one, in_axes=(0, 0, None, None)))(qpos, qvel, *learner)
    alone = jax.jit(distance)
    expected = [alone(qpos[0], qvel[0], *(x[k] for x in learner)) for k in range(5)]
    np.testing.assert_allclose(actual, expected, rtol=1e-6)  # float32, fused and not
    np.testing.assert_allclose(distance(qpos[0], qvel[0], *learner), actual, rtol=1e-6)
    np.testing.assert_allclose(every[0], expected, rtol=1e-6)


def test_zero_with_finite_gradients_at_a_match():
    """Exactly without compilation; a compiled function may round the two arms differently."""
    arm = planar_arm([0.5, 0.2, 0.3])
    distance = jax.value_and_grad(motion_distance(arm, arm, 2 * np.eye(arm.num_links), ALL_WEIGHTS), (2, 3))
    compiled, one = jax.jit(jax.vmap(distance)), jax.jit(distance)
    qpos, qvel, *_ = motions((arm, arm), dtype=np.float32)
    for motion in ((qpos, qvel), (qpos, 0 * qvel), (0 * qpos, 0 * qvel)):
        with jax.disable_jit():
            value, gradients = distance(*(x[0] for x in (*motion, *motion)))
        assert value == 0 and not np.any(gradients)
        for apart in (0.0, 1e-20, 1e-7):  # the square of the second underflows
            batch = *motion, motion[0] + apart, motion[1]
            for value, gradients in (compiled(*batch), one(*(x[0] for x in batch))):
                assert np.all(value < 1e-5)  # float32, times weights of up to 3
                assert np.all(np.isfinite(gradients)) and np.abs(gradients).max() < 100  # weights, angular velocities


def test_dtypes_are_kept(x64):
    arms = EXPERT, LEARNER
    distance = motion_distance(*arms, overlap_correspondence(*arms))
    for dtype in (np.float32, np.float64):
        sample = [x[0] for x in motions(arms, dtype=dtype)]
        value, gradient = jax.jit(jax.value_and_grad(distance, 2))(*sample)
        assert value.dtype == gradient.dtype == dtype
    mixed = jax.eval_shape(distance, *sample[:2], *(np.asarray(x, np.float32) for x in sample[2:]))
    assert mixed.dtype == np.float64


def test_compiled_functions_of_long_arms_do_not_grow():
    def operations(joints):
        arms = planar_arm(np.full(joints, 0.1)), planar_arm(np.full(joints, 0.2))
        distance = jax.jit(motion_distance(*arms, overlap_correspondence(*arms)))
        sample = [x[0] for x in motions(arms, dtype=np.float32)]
        return distance.lower(*sample).as_text().count("stablehlo.multiply")

    assert operations(LONG + 1) == operations(2 * LONG)


@pytest.mark.usefixtures("unchecked")
def test_bad_arguments_are_rejected():
    arms = EXPERT, LEARNER
    with pytest.raises(ValueError, match=r"^correspondence: expected shape \(3, 2\)"):
        motion_distance(*arms, np.ones((2, 3)))
    wrong: dict = {"rotation": "euler"}
    with pytest.raises(ValueError, match="^rotation: expected one of cosine, angle, got 'euler'"):
        motion_distance(*arms, hard_correspondence, **wrong)
    sample = [x[0] for x in motions(arms, dtype=np.float32)]
    with pytest.raises(ValueError, match=r"^learner_qvel: expected shape \[\.\.\., 2\]"):
        motion_distance(*arms, overlap_correspondence(*arms))(*sample[:3], jnp.zeros(3))


def test_parts_of_weight_zero_are_not_computed():
    arms = EXPERT, LEARNER
    motion = [jnp.zeros(arm.num_joints) for arm in arms for _ in range(2)]

    def operations(correspondence, weights):
        program = jax.jit(motion_distance(*arms, correspondence, weights)).lower(*motion).as_text()
        return program.count("stablehlo.multiply"), program.count("stablehlo.rsqrt")

    overlap = overlap_correspondence(*arms)
    multiplications, roots = operations(overlap, PAPER_WEIGHTS)
    assert roots == 2 * np.count_nonzero(overlap)  # of two velocities a pair
    assert operations(overlap, DistanceWeights(rotation=1.0))[1] == 0
    assert multiplications < operations(np.ones((3, 2)), PAPER_WEIGHTS)[0]


# --- the GPU kernel ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, fused_kernel.DEFAULT.block, fused_kernel.DEFAULT.block + 1])
@pytest.mark.usefixtures("interpreted")
def test_the_kernel_equals_the_plain_function(count):
    def program(x, y):
        return [[x[0] * y[1] + 2.0], [jnp.sin(x[1]), 0.5, y[0] - x[0]]]

    rows = [jnp.asarray(x, jnp.float32) for x in np.random.default_rng(0).normal(size=(2, count, 2))]
    actual = jax.jit(lambda *rows: fused_kernel.gpu_kernel(program, (1, 3))(*rows))(*rows)
    expected = jax.jit(jax.vmap(fused_kernel.fused(program, (1, 3))))(*rows)
    for values, reference, width in zip(actual, expected, (1, 3), strict=True):
        assert values.shape == (count, width)
        np.testing.assert_allclose(values, reference, rtol=1e-6)  # float32, fused and not


def test_value_and_gradient_are_one_kernel_on_a_gpu():
    arms = PAIRS["planar"]
    distance = motion_distance(*arms, overlap_correspondence(*arms))
    batch = motions(arms, dtype=np.float32)
    for function in (distance, jax.value_and_grad(distance, (2, 3)), jax.grad(distance, 0)):
        compiled = jax.jit(jax.vmap(function))
        assert gpu_program(compiled, *batch).count("triton") == 1
        assert "triton" not in compiled.lower(*batch).as_text()


def test_the_kernel_lowers_in_double_precision(x64):
    arms = PAIRS["planar"]
    gradient = jax.vmap(jax.grad(motion_distance(*arms, overlap_correspondence(*arms)), 2))
    assert "triton" in gpu_program(jax.jit(gradient), *motions(arms))


@pytest.mark.gpu
def test_the_gpu_agrees_with_double_precision():
    arms = panda(), panda(locked=(3, 6, 7))
    metric = overlap_correspondence(*arms), PAPER_WEIGHTS
    batch = motions(arms, 10_001, np.float32)
    actual = jax.jit(jax.vmap(jax.value_and_grad(motion_distance(*arms, *metric), ALL_ARGUMENTS)))(*batch)
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        plain = jax.jit(jax.vmap(jax.value_and_grad(composed(arms, *metric), ALL_ARGUMENTS)))
        expected = plain(*(np.asarray(x, np.float64) for x in batch))
    assert largest_difference(actual, expected) < 1e-5  # float32, there and back over the joints
