"""Generated arms against C MuJoCo in double precision, each as constants and as data of one function."""

import math
from functools import partial

import jax
import numpy as np
import pytest

from mimic.metric.kinematics import link_state_table, link_states
from mimic.physics import dynamics
from mimic.physics.joint_numbers import joints_of_model
from tests.helpers import random_arms
from tests.helpers.array_cases import Batch, random_source, torque_of_arm

SEED = 5000  # of the first arm; no other test has these
RTOL = 1e-12  # of the largest number of an arm's result


@pytest.fixture(scope="module", params=[24, pytest.param(100, marks=pytest.mark.slow)])
def batch(request):
    """Arms of 1 to 8 joints."""
    return Batch([random_source(SEED + i) for i in range(request.param)])


def assert_equal(actual, expected):
    scale = max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(np.asarray(actual) / scale, expected / scale, rtol=0, atol=RTOL)


def test_link_states(x64, batch):
    as_data = jax.tree.map(np.asarray, jax.jit(jax.vmap(link_states))(batch.arrays, batch.qpos, batch.qvel))
    for i, (source, arm, (qpos, qvel, *_)) in enumerate(zip(batch.sources, batch.arms, batch.motions, strict=True)):
        embodiment = arm.embodiment
        expected = random_arms.links(source, random_arms.posed(source, qpos, qvel), embodiment.link_names)
        constant = link_state_table(embodiment, qpos, qvel, float)
        for name, values in expected.items():
            unit = embodiment.chain_length if name in ("position", "linear_velocity") else 1.0
            assert_equal(unit * getattr(constant, name), values)
            assert_equal(unit * getattr(as_data, name)[i, : embodiment.num_links], values)


def test_inverse_dynamics(x64, batch):
    as_data = jax.jit(jax.vmap(torque_of_arm))(batch.arrays, batch.qpos, batch.qvel, batch.qacc)
    for arm, motion, torque in zip(batch.arms, batch.motions, np.asarray(as_data), strict=True):
        *state, expected = motion
        constant = dynamics.inverse(joints_of_model(arm.model), *(x.tolist() for x in state), trigonometry=trigonometry)
        assert_equal(constant, expected)
        assert_equal(torque[: len(expected)], expected)
        assert not torque[len(expected) :].any()


def trigonometry(angle):
    return math.cos(angle), math.sin(angle)


def test_forward_dynamics_invert_the_inverse(x64, batch):
    """Relative to the condition of the inertia, which rounding errors of a torque are multiplied by."""
    inertia = jax.jit(jax.vmap(dynamics.inertia_matrix))(batch.arrays, batch.qpos)
    forward = partial(dynamics.acceleration, trigonometry=trigonometry)
    for arm, (qpos, qvel, qacc, torque), matrix in zip(batch.arms, batch.motions, np.asarray(inertia), strict=True):
        joints = dynamics.loaded(joints_of_model(arm.model), 1.0, 1.0)
        actual = forward(joints, *(x.tolist() for x in (qpos, qvel, torque)))
        condition = np.linalg.cond(matrix[: len(qpos), : len(qpos)])
        tolerance = RTOL * condition * max(1.0, np.abs(qacc).max())
        np.testing.assert_allclose(actual, qacc, rtol=0, atol=tolerance)
