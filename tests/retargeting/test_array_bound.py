"""The kinematic bound of arms as arrays, against that of the same arms compiled in."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import arm_arrays, stack_arms
from mimic.metric.config import MetricConfig, check_metric
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.distance import Metric
from mimic.metric.kinematics import link_states
from mimic.retargeting.array_bound import closest_motion
from tests.helpers.array_cases import padded
from tests.retargeting.test_kinematic_bound import demonstration

WEIGHTS = check_metric(MetricConfig(hand_rotation=0.0))
pytestmark = pytest.mark.slow  # compiling the search for both kinds of arms takes over a minute

MOTION = [x[:3] for x in demonstration(7)]  # at its end the expert stands
# Locked joints and limits: without limits the joints are continuous.
LEARNERS = [((), "none"), ((2,), "hardware"), ((3, 6, 7), "none")]


def arrays(locked, limits="none"):
    free = ~np.isin(np.arange(1, 8), locked)
    return arm_arrays(build_arm(ArmConfig(), limits), free).astype(np.float32)


TRACES = []


@jax.jit(compiler_options={"xla_backend_optimization_level": 1})  # which compiles faster
def solve(arms, qpos, qvel):
    """The closest motions of a batch of arms to the Panda, and their distances computed from these motions."""
    expert = arrays(())

    def of_arm(arm):
        TRACES.append(arm)
        metric = Metric(arc_length_correspondence(expert, arm), WEIGHTS)
        states = jax.vmap(lambda *motion: link_states(expert, *motion))(qpos, qvel)
        closest = closest_motion(arm, metric, states, qpos)
        own_states = jax.vmap(lambda *motion: link_states(arm, *motion))(closest.qpos, closest.qvel)
        return closest, jax.vmap(metric)(states, own_states)

    return jax.vmap(of_arm)(arms)


def solved(arms):
    motion = (np.stack([padded(row) for row in x]).astype(np.float32) for x in MOTION)
    return jax.tree.map(np.asarray, solve(arms, *motion))


@pytest.fixture(scope="module")
def batch():
    """The arms above, their closest motions, and the distances of these."""
    arms = stack_arms([arrays(*learner) for learner in LEARNERS])
    return arms, *solved(arms)


@pytest.mark.parametrize("row", range(1, len(LEARNERS)))
def test_the_bound_is_that_of_the_arm_compiled_in(batch, row):
    locked, limits = LEARNERS[row]
    expert, learner = (
        build_arm(ArmConfig(locked=list(joints)), limits).embodiment
        for joints, limits in (((), "none"), (locked, limits))
    )
    metric = MetricConfig(hand_rotation=0.0).build(expert, learner).arguments  # arms as arrays have no hand
    expected = np.asarray(mimic.kinematic_bound(expert, learner, *MOTION, **metric))
    actual = batch[1].distance[row]
    # Both are results of a search, from other random poses; here both find the same poses. What is left is how near
    # velocities come to kinks: 2e-6 to 2e-5 by processor, and 1.4e-4 without their refinement.
    np.testing.assert_allclose(actual, expected, rtol=0, atol=5e-5)
    assert np.all(actual <= 1.01 * expected)


def test_the_bound_of_an_arm_and_itself_is_zero(batch):
    # The descents alone end 1e-4 above this kink. The refinement leaves 4e-7.
    np.testing.assert_allclose(batch[1].distance[0], 0, atol=1e-5)


def test_the_distance_is_that_of_the_returned_motion(batch):
    _, closest, expected = batch
    np.testing.assert_allclose(closest.distance, expected, rtol=1e-4, atol=1e-6)  # float32; fused in another order


def test_locked_joints_and_empty_slots_do_not_move(batch):
    """Although the guess moves them."""
    arms, closest, _ = batch
    rests = np.broadcast_to(arms.is_free[:, None] == 0, closest.qpos.shape)
    home = np.broadcast_to(arms.home[:, None], closest.qpos.shape)
    np.testing.assert_array_equal(closest.qpos[rests], home[rests])
    assert not closest.qvel[rests].any()
    assert np.all(closest.qpos[~rests] != home[~rests]) and np.all(closest.qvel[~rests])


def test_other_arms_compile_nothing(batch):
    """Neither other locked joints nor other lengths do; the results are those of these arms."""
    arms = stack_arms([arrays(locked) for locked in ((1,), (4, 5))] + [arrays((2,), "hardware")])
    longer = dataclasses.replace(arms, offset=np.float32(1.2) * arms.offset)
    other = solved(longer)[0]
    assert len(TRACES) == 1
    assert np.all(other.distance[2] > 1.01 * batch[1].distance[1])  # the same arm but for its lengths


def test_bad_input_is_rejected(unchecked):
    arm = arrays(())
    metric = Metric(arc_length_correspondence(arm, arm), WEIGHTS)
    states = jax.vmap(lambda qpos: link_states(arm, qpos))(jnp.zeros((3, 8)))
    for guess in (jnp.zeros((3, 7)), jnp.zeros((2, 8)), jnp.zeros(8)):
        with pytest.raises(ValueError, match=r"guess: expected shape \(3, 8\)"):
            closest_motion(arm, metric, states, guess)
    for options in ({"starts": 0}, {"iterations": 0}):
        with pytest.raises(ValueError, match="starts, iterations: expected at least 1, got"):
            closest_motion(arm, metric, states, jnp.zeros((3, 8)), **options)
