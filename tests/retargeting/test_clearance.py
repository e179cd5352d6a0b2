"""The clearance by NumPy: the distances of the retargeting costs, by JAX, and of C MuJoCo."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.capsules import fit_capsules
from mimic.control.clearance import clearance
from mimic.metric.capsule_distances import capsule_axes, changing_pairs, clearance_constants, pair_distances
from tests.helpers.metric_cases import random_poses

CONFIGS = {"locked": ArmConfig(locked=[3, 6, 7]), "two arms": ArmConfig(model="panda_pair")}


@pytest.mark.slow_for("two arms")
@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_it_is_the_distance_of_the_costs(config):
    arm, capsules = build_arm(config, "hardware").embodiment, fit_capsules(config, "hardware")
    is_changing, moves = changing_pairs(arm, capsules), np.flatnonzero(~np.array(capsules.near_base))

    def expected(qpos):
        start, end = capsule_axes(arm, capsules, qpos)
        height = jnp.minimum(start[moves, 2], end[moves, 2]) - capsules.radius[moves].astype(np.float32)
        return jnp.minimum(pair_distances(capsules, start, end)[np.flatnonzero(is_changing)].min(), height.min())

    qpos = random_poses(arm, 500)
    actual = clearance(qpos, clearance_constants(arm, capsules))
    assert np.ptp(actual) > 0.1 and actual.dtype == np.float32
    # The costs smooth distances by 0.1 mm where axes cross; there is none otherwise.
    np.testing.assert_allclose(actual, jax.jit(jax.vmap(expected))(qpos), atol=2e-4)


def test_the_floor_may_be_lower():
    config = ArmConfig(locked=[1, 3, 4, 6, 7])
    arm, capsules = build_arm(config, "hardware").embodiment, fit_capsules(config, "hardware")
    capsules = dataclasses.replace(capsules, joint=(1,) * len(capsules.joint))  # on one body, so without pairs
    low, high = (clearance(np.zeros(2), clearance_constants(arm, capsules, height)) for height in (-0.1, 0.0))
    assert low == pytest.approx(high + 0.1, abs=1e-6)
