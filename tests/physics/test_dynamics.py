"""The dynamics of any arm against C MuJoCo in double precision."""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, arm_arrays, lock_joints, stack_arms
from mimic.physics import dynamics
from mimic.physics.joint_numbers import joints_of_model
from tests.helpers.array_cases import (
    Batch,
    acceleration,
    assert_near,
    looped,
    padded,
    random_source,
    torque_of_arm,
    unrolled,
)

COUNT = 48  # six arms of each number of joints

FORMS = {name: jax.jit(jax.vmap(function)) for name, function in {"kernel": unrolled, "looped": looped}.items()}


TORQUES = jax.jit(jax.vmap(torque_of_arm))


def both_forms(*arguments):
    """Accelerations of any number of arms by each form; both are compiled for one number of arms."""
    count = len(arguments[1])
    arguments = jax.tree.map(lambda x: np.resize(x, (COUNT, *x.shape[1:])), arguments)
    return {name: np.asarray(function(*arguments))[:count] for name, function in FORMS.items()}


@pytest.fixture(scope="module")
def batch():
    return Batch([random_source(seed) for seed in range(COUNT)])


def test_random_arms_accelerate_as_in_mujoco(x64, batch):
    """In the original models, which have all bodies and reference angles."""
    motions = zip(batch.sources, batch.motions, strict=True)
    expected = [padded(acceleration(source, qpos, qvel, force)) for source, (qpos, qvel, _, force) in motions]
    empty = np.arange(MAX_JOINTS) >= np.array([arm.model.nv for arm in batch.arms])[:, None]
    for actual in both_forms(batch.arrays, batch.qpos, batch.qvel, batch.torque).values():
        assert_near(actual, np.stack(expected))
        assert_near(actual, batch.qacc)  # what `torque` was computed from
        assert empty.any() and not actual[empty].any()


def test_inertia_matrix_is_that_of_mujoco(x64, batch):
    actual = np.asarray(jax.jit(jax.vmap(dynamics.inertia_matrix))(batch.arrays, batch.qpos))
    for matrix, arm, (qpos, *_) in zip(actual, batch.arms, batch.motions, strict=True):
        data, size = mujoco.MjData(arm.model), arm.model.nv
        data.qpos[:] = qpos
        mujoco.mj_forward(arm.model, data)
        reference = np.zeros((size, size))
        for column, unit in zip(reference, np.eye(size), strict=True):
            mujoco.mj_mulM(arm.model, data, column, unit)
        np.testing.assert_allclose(matrix[:size, :size], reference, rtol=0, atol=1e-12)  # rounding of 10 kg m^2
        np.testing.assert_array_equal(matrix[size:], np.eye(MAX_JOINTS)[size:])


def test_a_lock_mask_of_the_panda_is_the_model_without_these_joints(x64):
    """A fifth of all 127 masks in one batch, at home poses other than 0."""
    panda = build_arm(ArmConfig(), limits="hardware")
    names = np.array(panda.embodiment.joint_names)
    whole, rng = arm_arrays(panda), np.random.default_rng(0)
    assert np.any(whole.home)
    rows, expected = [], []
    for free in itertools.islice(itertools.product((False, True), repeat=7), 1, None, 5):
        free = np.array(free)
        reduced = build_arm(ArmConfig(locked=names[~free].tolist()), limits="hardware").model
        state = rng.uniform(-np.pi, np.pi, free.sum()), *rng.normal(size=(2, free.sum()))
        qpos, (qvel, torque, qacc) = whole.home.copy(), np.zeros((3, MAX_JOINTS))
        for values, own in zip((qpos, qvel, torque, qacc), (*state, acceleration(reduced, *state)), strict=True):
            values[:7][free] = own
        torque[:7][~free] = 1.0  # it has no effect on a locked joint
        rows.append((arm_arrays(panda, free.tolist()), lock_joints(whole, padded(~free)), qpos, qvel, torque, free))
        expected.append(qacc)
    arms, locked, *states, free = zip(*rows, strict=True)
    jax.tree.map(np.testing.assert_array_equal, stack_arms(arms), stack_arms(locked))
    for actual in both_forms(stack_arms(arms), *map(np.stack, states)).values():
        assert_near(actual, np.stack(expected))
        assert not actual[:, :7][~np.stack(free)].any() and not actual[:, 7:].any()


def test_a_locked_joint_without_inertia_is_harmless(x64):
    """The pivot of a free one would be 0, as in MuJoCo."""
    arm = arm_arrays(build_arm(ArmConfig()))
    for values in (arm.first_moment, arm.second_moment, arm.armature):
        values[6] = 0
    arm = lock_joints(arm, np.arange(MAX_JOINTS) == 6)
    state = np.full((3, MAX_JOINTS), 0.3)
    for actual in both_forms(stack_arms([arm]), *state[:, None]).values():
        motion = (np.tile(x, (COUNT, 1)) for x in (*state[:2], actual))
        torque = TORQUES(stack_arms([arm] * COUNT), *motion)[0]
        np.testing.assert_allclose(torque[:6], 0.3, atol=1e-12)  # rounding
        assert torque[6] == 0


def test_the_inverse_holds_on_an_accelerated_base(x64):
    """As under gravity: forward dynamics of its torques give the accelerations again."""
    joints, rng = joints_of_model(build_arm(ArmConfig()).model), np.random.default_rng(0)
    qpos, qvel, qacc = (list(jnp.asarray(rng.normal(size=7))) for _ in range(3))
    base = (0.3, -2.0, 9.0)
    torque = dynamics.inverse(joints, qpos, qvel, qacc, base)
    forward = dynamics.acceleration(joints, qpos, qvel, torque, base)
    np.testing.assert_allclose(forward, qacc, rtol=1e-9)
    assert np.abs(np.subtract(torque, dynamics.inverse(joints, qpos, qvel, qacc))).max() > 1  # weight of the arm
