"""The hand in the metric: closed forms, gradients, and that no joint that moves the hand is without effect."""

import jax
import numpy as np
import pytest
from mujoco import MjModel

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import arm_arrays
from mimic.arms.embodiment import load_mjcf, panda_path
from mimic.metric.config import MetricConfig
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.distance import DistanceWeights, Metric
from mimic.metric.hand import HandWeights
from mimic.metric.kinematics import hand_frames, link_state_table, link_states
from mimic.metric.motion_distance import motion_distance
from mimic.retargeting.pose import imitate_pose
from mimic.retargeting.pose_objective import automatic_derivatives, pose_objective
from tests.helpers.original_model import ur_like, urdf

# Few joints and links, which compile quickly; the last joint is the one about the hand's axis.
EXPERT = mimic.panda(locked=[1, 3, 5], links="merged")
LOCKED = [1, 2, 3, 5]
LEARNER = mimic.panda(locked=LOCKED, links="merged")
LINKS = DistanceWeights(1.0, 1.0, 0.001, 0.01)
ALL = HandWeights(0.3, 0.2, 0.1)
EXACT = 1e-12  # double precision


def motion(seed=0, count=5):
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(count, arm.num_joints)) for arm in (EXPERT, EXPERT, LEARNER, LEARNER)]


def angles(a, b):
    """Angles of the rotations between two batches of hand frames, from their traces."""
    trace = np.einsum("...ij,...ij->...", np.asarray(a.rotation), np.asarray(b.rotation))
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))[..., 0]


def test_the_rotation_is_the_smooth_measure_of_the_angle_between_the_frames(x64):
    qpos, _, learner_qpos, _ = motion()
    nothing = np.zeros((EXPERT.num_links, LEARNER.num_links))
    metric = Metric(nothing, LINKS, hand_weights=HandWeights(rotation=1.0))
    distance = metric(link_states(EXPERT, qpos), link_states(LEARNER, learner_qpos))
    theta = angles(hand_frames(EXPERT, qpos), hand_frames(LEARNER, learner_qpos))
    np.testing.assert_allclose(distance, np.pi / 2 * (1 - np.cos(theta)), atol=EXACT)


def test_the_kernel_and_its_gradient_equal_automatic_differentiation(x64):
    matrix = arc_length_correspondence(EXPERT, LEARNER)
    metric = Metric(matrix, LINKS, hand_weights=ALL)
    kernel = motion_distance(EXPERT, LEARNER, matrix, LINKS, hand_weights=ALL)

    def composed(*x):
        return metric(link_states(EXPERT, *x[:2]), link_states(LEARNER, *x[2:]))

    both = [jax.jit(jax.vmap(jax.value_and_grad(f, range(4))))(*motion()) for f in (kernel, composed)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=EXACT), *both)
    assert all(np.abs(gradient).max() > 1e-3 for gradient in both[0][1])


def test_the_derivatives_of_the_pose_search_equal_automatic_differentiation(x64):
    """Of an arm as data. 1e-3: lengths are smoothed by 1e-3 chain lengths, which these poses are far from."""
    matrix = np.asarray(arc_length_correspondence(EXPERT, LEARNER))
    arm = build_arm(ArmConfig(locked=LOCKED), "none", "merged")
    learner = arm_arrays(arm, slots=(LEARNER.num_joints, LEARNER.num_links))
    metric = Metric(matrix, LINKS, hand_weights=ALL)
    qpos, _, learner_qpos, _ = (x[0] for x in motion())
    states, objective = link_states(EXPERT, qpos), pose_objective(learner, metric)
    batch = jax.tree.map(lambda x: x[..., None], objective.target(states))
    actual = jax.jit(objective.of_batch(batch))(tuple(np.full((1, 1), q) for q in learner_qpos))
    expected = jax.jit(lambda *q: automatic_derivatives(lambda q: metric(states, link_states(learner, q)), q))(
        *learner_qpos
    )
    np.testing.assert_allclose(np.ravel(actual.gradient), np.ravel(expected.gradient), atol=1e-3)
    for row, columns in enumerate(actual.hessian):
        np.testing.assert_allclose(np.ravel(columns), np.ravel(expected.hessian[row][: row + 1]), atol=1e-3)


ARMS = {
    "panda": lambda _: mimic.panda(),
    "pair": lambda _: load_mjcf(panda_path("panda_pair"), tip=["left_tcp", "right_tcp"]),
    "planar": lambda _: mimic.planar_arm([0.3, 0.2, 0.1]),
    "MJCF": lambda _: load_mjcf(MjModel.from_xml_string(ur_like())),
    "URDF": lambda folder: _read_urdf(folder / "four.urdf"),
}


def _read_urdf(file):
    file.write_text(urdf())
    return load_mjcf(file)


@pytest.mark.parametrize("name", ARMS)
def test_each_joint_that_moves_the_hand_changes_the_distance(tmp_path, name):
    """A joint rotates the hand by its own angle, whatever the other angles are."""
    arm = ARMS[name](tmp_path)
    metric, angle = MetricConfig().build(arm, arm), 0.5
    qpos = np.random.default_rng(1).uniform(-1, 1, arm.num_joints)
    shifted = np.concatenate([[qpos], qpos + angle * np.eye(arm.num_joints)])
    states = [
        link_state_table(arm, q, np.zeros_like(q), float) for q in (np.broadcast_to(qpos, shifted.shape), shifted)
    ]
    same, *moved = np.asarray(jax.jit(metric)(*states))
    assert same == 0
    assert np.all(np.array(moved) >= 0.02 * np.pi / 2 * (1 - np.cos(angle)) / len(arm.hand_joint) - 1e-6)


def test_a_hand_is_found_with_its_roll_by_its_weight_alone():
    """Without a weight the metric does not see the last joint. The joints have other names, so none is copied."""
    poses = np.random.default_rng(2).uniform(-1, 1, (8, EXPERT.num_joints)).astype(np.float32)
    learner = EXPERT.replace(joint_names=tuple("abcd"))
    errors = []
    for weight in (0.0, 0.1):
        metric = MetricConfig(hand_rotation=weight).build(EXPERT, learner)
        found = imitate_pose(EXPERT, learner, poses, **metric.arguments)
        errors.append(np.degrees(angles(hand_frames(EXPERT, poses), hand_frames(learner, found.qpos))))
    assert np.median(errors[0]) > 20 and np.max(errors[1]) < 5


def test_tables_and_arms_as_data_have_the_same_hands(x64):
    qpos, qvel, *_ = motion()
    expected = link_states(EXPERT, qpos, qvel).hand
    table = link_state_table(EXPERT, qpos, qvel, np.float64).hand
    arm = build_arm(ArmConfig(locked=[1, 3, 5]), "none", "merged")
    slots = EXPERT.num_joints + 1, EXPERT.num_links
    data = jax.jit(jax.vmap(lambda *x: link_states(arm_arrays(arm, slots=slots), *x)))
    padded = (np.pad(x, ((0, 0), (0, 1))) for x in (qpos, qvel))
    for hands in (table, data(*padded).hand):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=EXACT), hands, expected)


def test_an_arm_without_a_hand_is_named():
    metric = Metric(np.ones((EXPERT.num_links, EXPERT.num_links)), LINKS, hand_weights=ALL)
    states = link_states(EXPERT, np.zeros(EXPERT.num_joints))
    with pytest.raises(ValueError, match=r"hand_weights: expected 1 hand\(s\) of the learner, which has 0"):
        metric(states, states.replace(hand=None))
