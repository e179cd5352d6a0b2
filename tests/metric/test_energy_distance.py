"""The energy distance: closed forms, and what it ignores."""

import dataclasses

import jax
import numpy as np
import pytest

import mimic
from mimic.metric.config import MetricConfig
from mimic.metric.kinematics import link_state_table

DIRECTIONS = MetricConfig(translation=0.0, linear_velocity=0.0, angular_velocity=0.0, hand_rotation=0.0)


def states_of(arm, qpos):
    return link_state_table(arm, qpos, np.zeros_like(qpos))


def distance(expert, learner, x, y, metric=None):
    return float(jax.jit(lambda *states: mimic.energy_distance(expert, learner, *states, metric))(x, y))


def angles(half_width, shift, count):
    """A uniform distribution of the joint angle, at the midpoints of equal intervals."""
    return shift + half_width * (2 * (np.arange(count) + 0.5) / count - 1)[:, None]


def test_uniform_angles_of_a_single_link(x64):
    """The link distance is pi/2 (1 - cos beta), and the mean of cos over a uniform angle in [-a, a] is sin(a) / a."""
    arm, width, shift = mimic.planar_arm([1.0]), 0.8, 0.5
    x, y = states_of(arm, angles(width, 0.0, 400)), states_of(arm, angles(width, shift, 300))
    expected = np.pi * (np.sin(width) / width) ** 2 * (1 - np.cos(shift))
    assert distance(arm, arm, x, y, DIRECTIONS) == pytest.approx(expected, rel=1e-4)
    assert distance(arm, arm, x, x, DIRECTIONS) == pytest.approx(0, abs=1e-12)


def test_it_compares_distributions_and_not_pairs(x64):
    """The order of the samples does not matter; one state each gives twice the embodiment distance."""
    expert, learner = mimic.panda(), mimic.panda(locked=(3, 6, 7))
    rng = np.random.default_rng(0)
    x, y = states_of(expert, rng.normal(size=(6, 7))), states_of(learner, rng.normal(size=(5, 4)))
    value = distance(expert, learner, x, y)
    assert distance(expert, learner, x, jax.tree.map(lambda a: a[::-1], y)) == pytest.approx(value)
    one, other = (jax.tree.map(lambda a: a[:1], states) for states in (x, y))
    single = jax.jit(MetricConfig().build(expert, learner))(one, other)[0]
    assert distance(expert, learner, one, other) == pytest.approx(2 * float(single))
    without = dataclasses.replace(MetricConfig(), hand_rotation=0.0)
    assert distance(expert, learner, x, y, without) < value
