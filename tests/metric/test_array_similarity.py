"""Measures of similarity of arms as arrays, against those of their embodiments."""

import jax
import numpy as np

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import arm_arrays, stack_arms
from mimic.evaluation.rollout_metrics import measure_similarity
from mimic.metric.similarity import MEASURES, centre_line_table
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
        result.append((arm_arrays(arm), np.stack([padded(row) for row in own]), arm.embodiment, own))
    return result


def test_measures_are_those_of_the_embodiments():
    """Of the Panda as the expert; each time is a row of one step."""
    arms = cases()
    line = centre_line_table(arms[0][2], random_poses(7, 10)[:, None])
    rows = stack_arms([arm[0] for arm in arms for _ in range(TIMES)]).astype(np.float32)
    lines = jax.tree.map(lambda x: np.concatenate([x] * len(arms)), line)
    values = measure_similarity(lines, rows, np.concatenate([arm[1] for arm in arms])[:, None])
    assert set(values) == set(MEASURES)
    for i, (_, _, embodiment, qpos) in enumerate(arms):
        expected = measure_similarity(line, embodiment, qpos[:, None])
        for name in MEASURES:
            actual = values[name][i * TIMES : (i + 1) * TIMES]
            np.testing.assert_allclose(actual, expected[name], rtol=0, atol=atol(name))
            assert np.ptp(expected[name]) > 100 * atol(name)
