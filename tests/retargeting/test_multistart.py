"""Descents from several guesses: one loop on a CPU, two elsewhere, and the same poses."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.embodiment import planar_arm
from mimic.arms.pose_limits import pose_limits
from mimic.base import compat
from mimic.metric.config import MetricConfig
from mimic.metric.distance import Metric
from mimic.metric.kinematics import resting_link_states
from mimic.retargeting.multistart import Descents, best_descent
from mimic.retargeting.pose_objective import pose_objective

EXPERT, LEARNER = planar_arm([0.4, 0.35, 0.25]), planar_arm([0.6, 0.4])


def descend(guesses, *, kept, static=True):
    """Best descents of three poses from guesses [guesses, 2, 3]; so short that each guess ends elsewhere."""
    metric = MetricConfig().build(EXPERT, LEARNER)
    weights: Any = metric.weights if static else lambda _: metric.weights
    objective = pose_objective(LEARNER, Metric(metric.correspondence, weights))
    poses = jnp.asarray(np.random.default_rng(0).uniform(-3, 3, (3, 3)), guesses.dtype)
    targets = jax.vmap(objective.target, -1, -1)(resting_link_states(EXPERT, poses.T))
    limits = pose_limits(LEARNER, guesses.dtype)
    return best_descent(objective.of_batch(targets), guesses, limits, Descents(3, kept))


def guesses(count):
    return jnp.asarray(np.random.default_rng(1).uniform(-3, 3, (count, 2, 3)), np.float32)


def loops(function, *arguments):
    return [e for e in jax.make_jaxpr(function)(*arguments).eqns if e.primitive.name == "scan"]


@pytest.mark.slow
@pytest.mark.parametrize(("count", "static"), [(1, True), (5, False)])
def test_one_loop_gives_the_poses_of_two(count, static, monkeypatch):
    """Also with a number of guesses that is not a multiple of those kept. 1e-6: float32."""
    assert len(loops(lambda x: descend(x, kept=2, static=static), guesses(count))) == 1
    in_one = jax.jit(lambda x: descend(x, kept=2, static=static))(guesses(count))
    monkeypatch.setattr(compat, "is_cpu", lambda: False)
    assert len(loops(lambda x: descend(x, kept=2, static=static), guesses(count))) == 2
    in_two = jax.jit(lambda x: descend(x, kept=2, static=static))(guesses(count))
    np.testing.assert_allclose(in_one.value, in_two.value, atol=1e-6)
    np.testing.assert_allclose(in_one.qpos, in_two.qpos, atol=1e-3)  # flat directions


def test_more_guesses_do_not_end_higher():
    few, many = (jax.jit(lambda x: descend(x, kept=2))(guesses(8)[:count]) for count in (1, 8))
    assert np.all(many.value <= few.value + 1e-6) and np.any(many.value < few.value - 1e-3)
