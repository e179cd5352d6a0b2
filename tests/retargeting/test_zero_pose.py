"""A Panda with any of its joints locked can copy the expert's zero pose exactly, and the optimiser stays there."""

import itertools

import jax
import numpy as np
import pytest

from mimic.arms.embodiment import panda
from mimic.metric.config import MetricConfig
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.distance import embodiment_distance
from mimic.metric.kinematics import LinkStates, link_state_table, link_states
from mimic.retargeting.pose import imitate_pose

# Every set of locked joints but all seven: 127.
LOCKS = [joints for count in range(7) for joints in itertools.combinations(range(1, 8), count)]
METRIC, DIRECTIONS = MetricConfig(), MetricConfig(correspondence="overlap", translation=0.0)


def zero_states(arm):
    """Without compilation, which would take minutes for 127 arms."""
    return link_state_table(arm, np.zeros(arm.num_joints), np.zeros(arm.num_joints))


@pytest.mark.parametrize(
    ("metric", "locks"),
    [
        (METRIC, LOCKS[::12]),
        (DIRECTIONS, LOCKS[::12]),
        pytest.param(METRIC, LOCKS, marks=pytest.mark.slow),
    ],
    ids=["some", "directions", "all"],
)
def test_the_distance_is_zero_at_the_zero_pose(metric, locks):
    """1e-6: float32 rounds positions to 1e-7 chain lengths."""
    expert = panda()

    @jax.jit  # once for all: each of the arms has the expert's seven links
    def distance(expert_states: LinkStates, learner_states: LinkStates, matrix):
        return embodiment_distance(expert_states, learner_states, matrix, metric.make_weights())

    for joints in locks:
        learner = panda(locked=joints)
        assert learner.num_joints == 7 - len(joints) and learner.num_links == 7
        matrix = np.asarray(metric.make_correspondence(expert, learner))
        assert distance(zero_states(expert), zero_states(learner), matrix) <= 1e-6, joints


def test_the_distance_is_not_zero_elsewhere():
    """The other tests can fail: with merged links, and with a bent joint."""
    expert, merged = panda(), panda(locked=(3, 6, 7), links="merged")
    weights = METRIC.make_weights()
    apart = [(zero_states(expert), zero_states(merged), arc_length_correspondence(expert, merged))]
    bent = link_state_table(expert, 0.01 * np.eye(7)[1], np.zeros(7))
    apart.append((zero_states(expert), bent, arc_length_correspondence(expert, expert)))
    for expert_states, learner_states, matrix in apart:
        assert embodiment_distance(expert_states, learner_states, matrix, weights) > 1e-3


@pytest.mark.slow_for("(2, 3, 6, 7)")
@pytest.mark.parametrize("joints", [(2, 3, 6, 7), (1, 2, 3, 4, 5, 6)], ids=str)
def test_the_optimiser_stays_at_the_zero_pose(joints):
    expert, learner = panda(), panda(locked=joints)
    correspondence = METRIC.make_correspondence(expert, learner)
    pose = np.zeros(7, np.float32)
    solution = imitate_pose(expert, learner, pose, correspondence, METRIC.make_weights())
    expected, found = link_states(expert, pose), link_states(learner, solution.qpos)
    # The pose itself need not be 0: where joints are collinear, as 1, 3 and 5 are there, only their sum counts.
    assert solution.distance <= 1e-6 and solution.converged
    np.testing.assert_allclose(found.position, expected.position, atol=1e-5)
