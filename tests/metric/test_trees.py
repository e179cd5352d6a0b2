"""The metric between trees: correspondence by chains, closed-form gradients, similarity."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mimic.arms.embodiment import in_chain_lengths, load_mjcf
from mimic.metric.analytic_gradient import distance_and_gradient
from mimic.metric.config import MetricConfig
from mimic.metric.correspondence import arc_length_correspondence, overlap_correspondence
from mimic.metric.kinematics import link_state_table, link_states
from mimic.metric.similarity import MEASURES, centre_line, centre_line_table, similarity
from mimic.retargeting.costs import hand_cost
from mimic.retargeting.pose_objective import pose_objective
from tests.helpers.trees import TORSO_TIPS, hand, torso

SWAPPED = TORSO_TIPS[::-1]


@pytest.fixture(scope="module")
def body():
    return load_mjcf(mujoco.MjModel.from_xml_string(torso()), tip=TORSO_TIPS)


@pytest.fixture(scope="module")
def longer():
    """The same kind of body with four joints in each arm, and its chains in another order."""
    return load_mjcf(mujoco.MjModel.from_xml_string(torso(4)), tip=SWAPPED)


@pytest.fixture(scope="module")
def fingers():
    return load_mjcf(mujoco.MjModel.from_xml_string(hand()), tip=["*"])


def pose(arm, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, arm.num_joints), rng.normal(size=arm.num_joints)


@pytest.mark.parametrize(("correspondence", "name"), [("arc_length", "fingers"), ("overlap", "body"), ("hard", "body")])
def test_a_tree_has_no_distance_from_itself(x64, request, name, correspondence):
    arm = request.getfixturevalue(name)
    metric = MetricConfig(correspondence=correspondence, linear_velocity=1.0, angular_velocity=1.0).build(arm, arm)
    states, other = (link_state_table(arm, *pose(arm, seed), float) for seed in (0, 1))
    assert float(metric(states, states)) == 0 and float(metric(states, other)) > 0.1


def _sides(arm, link):
    return {name.split("_")[0] for chain, name in zip(arm.chains, arm.chain_names, strict=True) if link in chain}


@pytest.mark.parametrize("make", [arc_length_correspondence, overlap_correspondence])
def test_links_correspond_by_chain(body, longer, make):
    matrix = np.asarray(make(body, longer))
    side = [[_sides(arm, link) for link in range(arm.num_links)] for arm in (body, longer)]
    assert all(side[0][i] & side[1][j] for i, j in np.argwhere(matrix))
    assert np.all(matrix.sum(axis=0) > 0) and np.all(matrix.sum(axis=1) > 0)
    left, right = (body.link_names.index(f"{name}_joint1") for name in ("left", "right"))
    assert matrix[left, longer.link_names.index("right_joint1")] == 0
    assert matrix[right, longer.link_names.index("right_joint1")] > 0


def test_arc_length_is_the_mean_of_the_chains(body):
    """W of each pair of chains integrates to the same number."""
    matrix = np.asarray(arc_length_correspondence(body, body))
    assert matrix.mean() == pytest.approx(1)
    left = [link for link in body.chains[0] if link not in body.chains[1]]
    total = sum(body.link_lengths[link] for link in body.chains[0])
    expected = body.link_lengths[left] / total / 2 * body.num_links**2
    np.testing.assert_allclose(np.diag(matrix)[left], expected)


def test_traced_lengths_give_the_same_correspondence(x64, body, longer):
    traced = jax.jit(arc_length_correspondence)(body, longer)
    np.testing.assert_allclose(traced, arc_length_correspondence(body, longer), rtol=1e-12)


def test_gradients_in_closed_form(x64, body, longer):
    """Of links and two hands, against finite differences, on a batch of motions without compilation."""
    arms, motion = (in_chain_lengths(body), in_chain_lengths(longer)), [*pose(body), *pose(longer, 1)]
    weights = {"translation": 0.5, "linear_velocity": 0.1, "angular_velocity": 0.2, "hand_position": 0.3}
    metric = MetricConfig(**weights).build(body, longer)
    factors = np.asarray(metric.factors(*(len(arm.hand_joint) for arm in arms)))
    values, step = np.concatenate(motion), 1e-5
    shifts = step * np.eye(len(values))
    batch = jnp.asarray(np.concatenate([values + shifts, values - shifts, values[None]])).T
    parts = jnp.split(batch, np.cumsum([len(part) for part in motion])[:-1])
    (distance,), *gradients = distance_and_gradient(*arms, factors, range(4), *map(list, parts))
    gradient = [float(np.broadcast_to(entry, distance.shape)[-1]) for part in gradients for entry in part]
    above, below = np.split(np.asarray(distance)[:-1], 2)
    differences = (above - below) / (2 * step)
    np.testing.assert_allclose(gradient, differences, atol=1e-7 * np.abs(differences).max())
    states = link_states(body, *motion[:2]), link_states(longer, *motion[2:])
    assert factors.shape[1:] == (body.num_links + 6, longer.num_links + 6)  # a row for each axis of a hand
    assert np.asarray(distance)[-1] == pytest.approx(float(metric(*states)), rel=1e-12)


@pytest.mark.slow
def test_second_derivatives_of_poses(x64, body, longer):
    """Those of the closed form against finite differences; no joint of one arm moves the other."""
    objective = pose_objective(longer, MetricConfig(translation=1.0).build(body, longer))
    qpos, step = pose(longer, 1)[0], 1e-5
    target = objective.target(link_states(body, pose(body)[0]))
    evaluate = jax.jit(lambda q: objective.derivatives(target, list(q)))
    result, shifts = evaluate(qpos), step * np.eye(len(qpos))

    def difference(of):
        return np.array([(np.array(of(evaluate(qpos + x))) - of(evaluate(qpos - x))) / (2 * step) for x in shifts])

    scale = np.abs(result.gradient).max()
    np.testing.assert_allclose(result.gradient, difference(lambda x: np.array(x.value)), atol=1e-6 * scale)
    lower = [[row[j] if j <= i else 0.0 for j in range(len(qpos))] for i, row in enumerate(result.hessian)]
    hessian = difference(lambda x: np.array(x.gradient))
    np.testing.assert_allclose(np.array(lower, float), np.tril(hessian), atol=1e-6 * np.abs(hessian).max())
    left, right = (longer.joint_names.index(f"{side}_joint1") for side in ("left", "right"))
    assert lower[max(left, right)][min(left, right)] == 0


def test_similarity_of_trees(body, longer):
    qpos = pose(body)[0]
    line = centre_line_table(body, qpos)
    assert line.points.shape == (2, 64, 3)
    assert all(abs(float(value)) < 2e-2 for value in similarity(line, line).values())
    np.testing.assert_allclose(centre_line(body, qpos).points, line.points, atol=1e-5)
    swapped = load_mjcf(mujoco.MjModel.from_xml_string(torso()), tip=SWAPPED)
    again = similarity(line, centre_line_table(swapped, qpos))  # matched by the names of the chains
    assert set(again) == set(MEASURES) and all(abs(float(value)) < 2e-2 for value in again.values())
    batch = np.stack([pose(longer, seed)[0] for seed in range(3)])
    assert similarity(centre_line_table(body, np.stack([qpos] * 3)), centre_line_table(longer, batch))[
        "hand_angle_deg"
    ].shape == (3,)


def test_hand_costs_of_both_hands(x64, body):
    qpos = pose(body)[0]
    moved = np.stack([qpos] * 3)  # not at all, the left hand, and both
    moved[1:, body.joint_names.index("left_joint2")] += 0.3
    moved[2, body.joint_names.index("right_joint2")] += 0.3
    none, left, both = jax.jit(jax.vmap(lambda q: hand_cost(body, body, qpos, q)))(moved)
    assert abs(none) < 1e-12 < 1e-6 < left < both
