"""Another arm as data compiles nothing, and gives what the embodiment gives."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import arm_arrays, lock_joints
from mimic.metric.distance import DistanceWeights
from mimic.retargeting.costs import Costs
from tests.helpers.compilations import count_compilations

EXPERT = ArmConfig()
LOCKS = [(2, 3, 4, 5, 6), (1, 2, 4, 6, 7)]  # learners of two joints, with other links on each of them
WEIGHTS = DistanceWeights(1.0, 1.0, 0.001, 0.01)
FEW = {"starts": 3, "iterations": 8}


def as_data(config, joints):
    return arm_arrays(build_arm(config), slots=(joints, 8))


def poses(seed, *shape):
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


def matrix_of(*arms):
    return np.asarray(mimic.arc_length_correspondence(*arms))


@pytest.fixture(scope="module")
def learners():
    """Data, embodiment and correspondence of each learner; the functions below are compiled for the first one."""
    expert = as_data(EXPERT, 7)
    rows = []
    for locked in LOCKS:
        config = ArmConfig(locked=list(locked))
        data = as_data(config, 2)
        rows.append((data, build_arm(config).embodiment, matrix_of(expert, data)))
    return expert, rows


def imitated(expert, row, qpos, weights=WEIGHTS, **options):
    return mimic.imitate_pose(expert, row[0], qpos, row[2], weights, **FEW, **options)


def test_another_learner_compiles_nothing_and_its_pose_is_as_near(learners):
    expert, rows = learners
    imitated(expert, rows[0], poses(0, 4, 7))
    with count_compilations() as events:
        solutions = [imitated(expert, row, poses(1, 4, 7)) for row in rows[1:]]
        other = imitated(expert, rows[1], poses(1, 4, 7), DistanceWeights(0.5, 1.0))
    assert events == []
    assert np.abs(other.distance - solutions[0].distance).max() > 1e-3
    for (_, learner, _), solution in zip(rows[1:], solutions, strict=True):
        panda = mimic.panda()
        matrix = matrix_of(panda, learner)
        grid = np.stack(np.meshgrid(*2 * [np.linspace(-np.pi, np.pi, 100)]), -1).reshape(-1, 2)
        table = jax.jit(jax.vmap(lambda q, learner=learner: mimic.link_states(learner, q)))(grid)
        for qpos, own, distance in zip(poses(1, 4, 7), solution.qpos, solution.distance, strict=True):
            state = mimic.link_states(panda, qpos)
            value = mimic.embodiment_distance(state, mimic.link_states(learner, own), matrix, WEIGHTS)
            np.testing.assert_allclose(value, distance, rtol=1e-5)  # float32
            nearest = mimic.embodiment_distance(state, table, matrix, WEIGHTS).min()
            assert value <= nearest + 1e-4  # a search in steps of 0.06 rad


@pytest.mark.slow
def test_a_lock_mask_is_the_arm_without_these_joints(learners):
    expert, _ = learners
    locked = np.isin(np.arange(7), (1, 2, 4, 5, 6))
    data = lock_joints(expert, locked)
    qpos = poses(2, 3, 7)
    solution = mimic.imitate_pose(expert, data, qpos, matrix_of(expert, data), WEIGHTS)
    assert np.all(np.asarray(solution.qpos)[:, locked] == 0)
    learner = build_arm(ArmConfig(locked=[2, 3, 5, 6, 7])).embodiment
    expected = mimic.imitate_pose(mimic.panda(), learner, qpos, matrix_of(mimic.panda(), learner), WEIGHTS)
    np.testing.assert_allclose(solution.distance, expected.distance, atol=1e-4)  # float32, and the smoothed length


def test_link_states_and_motion_distance_are_compiled_once(learners):
    expert, rows = learners
    states = jax.jit(mimic.link_states)

    @jax.jit
    def distance(expert, learner, matrix, *motion):
        return mimic.motion_distance(expert, learner, matrix, WEIGHTS)(*motion)

    motion = (*poses(3, 2, 7), *poses(4, 2, 2))
    values = []
    for index, (data, learner, matrix) in enumerate(rows):
        with count_compilations() as events:
            link_states = states(data.astype(np.float32), motion[2], motion[3])
            values.append(distance(expert, data, jnp.asarray(matrix), *motion))
        assert bool(events) == (index == 0)
        expected = mimic.link_states(learner, motion[2], motion[3])
        np.testing.assert_allclose(link_states.position[: learner.num_links], expected.position, atol=1e-6)
        embodiments = mimic.panda(), learner
        reference = mimic.motion_distance(*embodiments, matrix_of(*embodiments), WEIGHTS)(*motion)
        np.testing.assert_allclose(values[index], reference, rtol=1e-5)


def test_what_only_embodiments_take_is_rejected(learners):
    expert, rows = learners
    with pytest.raises(ValueError, match="expected two embodiments or two arms as data, got one of each"):
        mimic.imitate_pose(mimic.panda(), rows[0][0], poses(0, 7), rows[0][2], WEIGHTS)
    cases: list[dict[str, Any]] = [{"costs": Costs(home=0.1)}, {"reduction": "frobenius"}]
    for changes in cases:
        with pytest.raises(ValueError, match="expected a constant correspondence and weights"):
            imitated(expert, rows[0], poses(0, 7), **changes)
