"""Measures of similarity of arms as arrays, against those of their embodiments."""

import jax
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import arm_arrays, stack_arms
from mimic.evaluation.rollout_metrics import measure_similarity
from mimic.metric.similarity import MEASURES, centre_line, centre_line_table, similarity
from tests.helpers.array_cases import padded

TIMES = 20
LOCKS = [(), (3, 6, 7), (2, 3, 6, 7)]
# Of lengths [chain lengths] and angles [rad]: float32, 6e-8 of each of about 20 steps from base to tip, amplified by
# angles from differences of unit vectors.
ATOL = 1e-5


def atol(name):
    return np.degrees(ATOL) if name.endswith("_deg") else ATOL


def random_poses(joints, seed):
    return np.random.default_rng(seed).uniform(-2, 2, (TIMES, joints)).astype(np.float32)


def wide(qpos):
    return np.stack([padded(row) for row in qpos]).astype(np.float32)


def cases():
    """Arrays, their poses [T, 8], the embodiment and its poses; the Panda's locked variants and planar arms."""
    result = []
    for seed, locked in enumerate(LOCKS):
        free = ~np.isin(np.arange(1, 8), locked)
        arrays = arm_arrays(build_arm(ArmConfig(), "hardware"), free)
        own = random_poses(free.sum(), seed)
        qpos = np.tile(arrays.home, (TIMES, 1)).astype(np.float32)
        qpos[:, np.flatnonzero(free)] = own
        result.append((arrays, qpos, build_arm(ArmConfig(locked=list(locked)), "hardware").embodiment, own))
    for lengths in ([0.5, 0.3], [0.1, 0.4, 0.35, 0.25, 0.2]):
        arm = build_arm(ArmConfig(model="planar", link_lengths=lengths))
        own = random_poses(len(lengths), len(lengths))
        result.append((arm_arrays(arm), wide(own), arm.embodiment, own))
    return result


@pytest.fixture(scope="module")
def batch():
    """The cases, the Panda as their expert with its poses, and the measures [cases, T] of one compiled function."""
    arms = cases()
    expert, expert_qpos = arms[0][0].astype(np.float32), random_poses(7, 10)

    def of_arm(expert, arm, expert_qpos, qpos):
        return similarity(centre_line(expert, expert_qpos), centre_line(arm, qpos))

    measure = jax.jit(jax.vmap(of_arm, (None, 0, None, 0)))
    learners = stack_arms([arm[0] for arm in arms]).astype(np.float32)
    values = measure(expert, learners, wide(expert_qpos), np.stack([arm[1] for arm in arms]))
    return arms, expert_qpos, jax.tree.map(np.asarray, values)


def test_measures_are_those_of_the_embodiments(batch):
    arms, expert_qpos, values = batch
    assert set(values) == set(MEASURES)
    line = centre_line_table(arms[0][2], expert_qpos[:, None])  # each time as a demonstration of one step
    for i, (_, _, embodiment, qpos) in enumerate(arms):
        expected = measure_similarity(line, embodiment, qpos[:, None])
        for name in MEASURES:
            np.testing.assert_allclose(values[name][i], expected[name], rtol=0, atol=atol(name))
            assert np.ptp(expected[name]) > 100 * atol(name)
