"""Measures of similarity: closed forms of planar arms, invariances, and the two implementations against each other."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.embodiment import panda, panda_path, planar_arm, without_hands
from mimic.metric import similarity
from mimic.metric.similarity import MEASURES, centre_line, centre_line_table
from tests.helpers.metric_cases import random_poses

ANGLE = 0.7  # rad
ARMS = {"kept": panda(locked=(3, 6, 7)), "merged": panda(locked=(3, 6, 7), links="merged")}


def compare(first, first_qpos, second, second_qpos):
    lines = (
        centre_line_table(arm, np.asarray(qpos, np.float32))
        for arm, qpos in ((first, first_qpos), (second, second_qpos))
    )
    return similarity.similarity(*lines)


def test_two_straight_arms_at_an_angle():
    values = compare(planar_arm([1.0]), [0.0], planar_arm([2.0, 3.0]), [ANGLE, 0.0])  # of another size, in two links
    chord = 2 * np.sin(ANGLE / 2)
    expected = {
        "centre_line_distance": chord / 2,
        "tangent_angle_deg": np.degrees(ANGLE),
        "frechet_distance": chord
        * (1 - 0.5 / similarity.SAMPLES),  # the last sample is half an interval before the end
        "hand_position_error": chord,
        "hand_angle_deg": np.degrees(ANGLE),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(values[name], value, rtol=1e-5, err_msg=name)  # float32


def test_a_bent_arm_against_a_straight_one():
    values = compare(planar_arm([1.0, 1.0]), [0.0, 0.0], planar_arm([1.0, 1.0]), [0.0, np.pi / 2])
    # The second half lies along y: at arc length 1/2 + t the points are sqrt(2) t apart, over t in [0, 1/2].
    np.testing.assert_allclose(values["centre_line_distance"], np.sqrt(2) / 8, rtol=1e-5)
    np.testing.assert_allclose(values["tangent_angle_deg"], 45, rtol=1e-5)
    np.testing.assert_allclose(values["hand_position_error"], np.sqrt(2) / 2, rtol=1e-5)
    np.testing.assert_allclose(values["hand_angle_deg"], 90, rtol=1e-5)


@pytest.mark.parametrize("links", ARMS)
def test_an_arm_resembles_itself_exactly_and_nothing_else(links):
    arm = ARMS[links]
    qpos = random_poses(arm, 8)
    same, other = compare(arm, qpos, arm, qpos), compare(arm, qpos, arm, qpos[::-1])
    for name in MEASURES:
        np.testing.assert_array_equal(same[name], 0)
        assert np.all(other[name] > 0), name


@pytest.mark.parametrize("links", ARMS)
def test_numpy_and_jax_agree(links):
    arm, expert_qpos = ARMS[links], random_poses(panda(), 16)
    qpos = random_poses(arm, 16, seed=1)
    one = lambda a, b: similarity.similarity(centre_line(panda(), a), centre_line(arm, b))  # noqa: E731
    batched, expected = jax.jit(jax.vmap(one))(expert_qpos, qpos), compare(panda(), expert_qpos, arm, qpos)
    for name in MEASURES:
        np.testing.assert_allclose(batched[name], expected[name], rtol=1e-4, atol=1e-4)  # degrees in float32


def test_centre_line_is_where_mujoco_has_the_links():
    import mujoco

    model = mujoco.MjModel.from_xml_path(panda_path())
    data = mujoco.MjData(model)
    qpos = random_poses(panda(), 1)[0]
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    line, length = centre_line_table(panda(), qpos, samples=200), float(panda().chain_length)
    np.testing.assert_allclose(line.hand_position * length, data.site("tcp").xpos, atol=1e-6)
    # The middle of each link is the centre of its site; the nearest sample is within half an interval of it.
    for link in range(1, 8):
        nearest = np.linalg.norm(line.points * length - data.site(f"link{link}").xpos, axis=1).min()
        assert nearest <= length / 200 / 2 + 1e-6


def leash_by_recursion(a, b):
    """The textbook's definition (Eiter and Mannila 1994)."""

    @functools.cache
    def leash(i, j):
        apart = float(np.linalg.norm(a[i] - b[j]))
        before = [leash(*ij) for ij in ((i - 1, j), (i - 1, j - 1), (i, j - 1)) if min(ij) >= 0]
        return max(apart, min(before)) if before else apart

    return leash(len(a) - 1, len(b) - 1)


def test_frechet_distance_is_that_of_its_definition():
    rng = np.random.default_rng(0)
    qpos = random_poses(panda(), 4), random_poses(panda(), 4, seed=1)
    lines = [centre_line_table(panda(), q, samples=n) for q, n in zip(qpos, (20, 13), strict=True)]
    shaken = [dataclasses.replace(line, points=line.points + rng.normal(0, 0.1, line.points.shape)) for line in lines]
    for first, second in (lines, shaken):
        expected = [leash_by_recursion(a, b) for a, b in zip(first.points, second.points, strict=True)]
        np.testing.assert_allclose(similarity.frechet_distance(first, second), expected, rtol=1e-5)
        in_jax = [jax.tree.map(jnp.asarray, line) for line in (first, second)]
        np.testing.assert_allclose(similarity.frechet_distance(*in_jax), expected, rtol=1e-5)


@pytest.mark.slow
def test_gradients_are_finite_at_a_match():
    qpos = random_poses(panda(), 1)[0]

    def total(q):
        return sum(similarity.similarity(centre_line(panda(), qpos), centre_line(panda(), q)).values())

    assert np.all(np.isfinite(jax.grad(total)(jnp.asarray(qpos))))


def test_fewer_than_one_sample_is_rejected(unchecked):
    with pytest.raises(ValueError, match="samples: expected at least 1, got 0"):
        centre_line_table(panda(), np.zeros(7), samples=0)


def test_the_rotation_of_hands_sees_the_last_joint_and_has_no_kink_that_is_nan():
    arm, pose = panda(), np.full(7, 0.3, np.float32)
    line = centre_line(arm, pose)

    @jax.jit
    def angle(qpos):
        return similarity.hand_rotation(line, centre_line(arm, qpos))

    np.testing.assert_allclose(angle(pose + 0.5 * np.eye(7, dtype=np.float32)[6]), 0.5, atol=1e-5)  # float32
    assert np.isfinite(jax.jit(jax.grad(angle))(pose)).all()
    assert np.isfinite(
        jax.grad(lambda qpos: similarity.hand_rotation(line, centre_line(arm, qpos)))(pose)
    ).all()  # a match to the bit


def test_the_rotation_to_an_arm_without_a_hand_is_not_known():
    pose = np.full(7, 0.3, np.float32)
    lines = [centre_line_table(arm, pose) for arm in (panda(), without_hands(panda()))]
    assert np.isnan(similarity.similarity(*lines)["hand_rotation_deg"])
