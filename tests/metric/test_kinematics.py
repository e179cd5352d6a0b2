import dataclasses
import math
import re

import jax
import jax.numpy as jnp
import jaxtyping
import mujoco
import numpy as np
import pytest

import mimic
from mimic.arms.embodiment import load_mjcf, panda, panda_path, planar_arm
from mimic.arms.model_files import read_model
from mimic.metric.kinematics import (
    LONG,
    body_twists,
    candidate_points,
    forward_kinematics,
    link_state_table,
    link_states,
    resting_link_states,
)
from tests.helpers import random_arms
from tests.helpers.trees import TORSO_TIPS, torso

# Against MuJoCo, in m, m/s and rad/s. Arms are up to 3 m long and move at up to 10 rad/s and 10 m/s.
TOLERANCE = {
    "float64": 1e-9,  # both sides round at 1e-15; the constants of the arms are exact to 1e-12
    "float32": 1e-5,  # rounding of 6e-8 a step, times 10 m/s, over the 10 to 20 steps from base to tip
}
POSES = 3

PANDA_LOCKED = {
    "free": (),
    "4dof": (3, 6, 7),
    "3dof": ("joint2", "joint3", "joint6", "joint7"),
    "base": (1, 2),
    "angles": {3: 0.4, "joint6": -0.7, 7: 1.1},
    "tip only": {"joint1": -0.3, 2: 0.5, 3: 2.0, 4: -1.5, 5: 0.1, 6: 1.0},
}


def motions(num_joints, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-np.pi, np.pi, (POSES, num_joints)), rng.uniform(-1, 1, (POSES, num_joints))


def full_motion(model, arm, qpos, qvel, locked=None):
    """Angles and velocities of all joints of a model, from those of the arm's free ones."""
    full = np.zeros((2, model.njnt))
    for joint, angle in (locked or {}).items():
        full[0, model.joint(joint if isinstance(joint, str) else joint - 1).id] = angle
    free = [model.joint(name).id for name in arm.joint_names]
    full[0, free], full[1, free] = qpos, qvel
    return full


def assert_moves_as_in_mujoco(arm, model, dtype, locked=None):
    qpos, qvel = (x[0].astype(dtype) for x in motions(arm.num_joints))  # MuJoCo gets the rounded numbers too
    states = link_states(arm, qpos, qvel, normalized=False)
    frames = forward_kinematics(arm, qpos)
    twists = np.asarray(body_twists(arm, qpos, qvel))
    data = random_arms.posed(model, *full_motion(model, arm, qpos, qvel, locked))
    rest = random_arms.posed(model, full_motion(model, arm, 0, 0, locked)[0])
    expected = random_arms.links(model, data, arm.link_names)
    body_rotation, body_rest_rotation = (random_arms.link_rotations(model, d, arm.link_names) for d in (data, rest))
    close = {"atol": TOLERANCE[dtype.name], "rtol": 0}
    for field, values in expected.items():
        np.testing.assert_allclose(getattr(states, field), values, err_msg=field, **close)
    rotation = np.asarray(frames.rotation)
    np.testing.assert_allclose(frames.position, expected["position"], **close)
    np.testing.assert_allclose(rotation[:, :, 0], expected["direction"], **close)
    turn = body_rotation @ np.swapaxes(body_rest_rotation, 1, 2)
    np.testing.assert_allclose(rotation, turn @ arm.link_rotation, **close)
    for part, field in ((slice(0, 3), "angular_velocity"), (slice(3, 6), "linear_velocity")):
        in_link_frame = np.einsum("nji,nj->ni", rotation, expected[field])
        np.testing.assert_allclose(twists[:, part], in_link_frame, err_msg=f"body twist, {field}", **close)


@pytest.mark.parametrize("seed", range(8))
def test_random_arms_move_as_in_mujoco(x64, seed):
    model = random_arms.random_arm(seed)
    arm = load_mjcf(model)
    assert arm.num_joints == model.njnt
    assert_moves_as_in_mujoco(arm, model, np.dtype("float64"))


def test_a_random_arm_moves_as_in_mujoco_in_single_precision():
    model = random_arms.random_arm(7)
    assert_moves_as_in_mujoco(load_mjcf(model), model, np.dtype("float32"))


@pytest.mark.parametrize("locked", [{}, {"joint1": 0.3, "joint7": -0.5}], ids=["free", "locked"])
def test_long_arms_move_as_in_mujoco(x64, locked):
    model = random_arms.random_arm(3, joints=LONG + 8)
    arm = load_mjcf(model, locked=locked, links="kept")
    assert arm.num_joints == LONG + 8 - len(locked) > LONG
    assert (-1 in arm.link_joint) == bool(locked)
    assert_moves_as_in_mujoco(arm, model, np.dtype("float64"), locked)


def test_long_arms_take_both_precisions_in_one_process():
    arm = planar_arm([0.1] * (LONG + 1))
    (qpos, *_), (qvel, *_) = motions(arm.num_joints)
    for wide in (False, True, False):
        dtype = np.dtype(np.float64 if wide else np.float32)
        with jax.enable_x64(wide):
            actual = jax.jit(lambda *motion: link_states(arm, *motion))(qpos.astype(dtype), qvel.astype(dtype))
            assert {leaf.dtype for leaf in jax.tree.leaves(actual)} == {dtype}


@pytest.mark.parametrize(
    ("links", "locked"),
    [
        ("kept", "free"),
        ("kept", "4dof"),
        ("merged", "4dof"),
        ("merged", "3dof"),
        ("kept", "base"),
        ("kept", "angles"),
        ("merged", "angles"),
        ("merged", "tip only"),
    ],
)
def test_panda_moves_as_in_mujoco(x64, links, locked):
    joints = PANDA_LOCKED[locked]
    arm, angles = panda(locked=joints, links=links), joints if isinstance(joints, dict) else None
    assert_moves_as_in_mujoco(arm, read_model(panda_path()), np.dtype("float64"), angles)


@pytest.mark.parametrize(
    ("lengths", "frame_at"), [([0.7], 0.5), ([0.2, 0.1, 0.4, 0.3], 1.0), (np.linspace(0.1, 0.3, LONG + 2), 0.0)]
)
def test_planar_arm_has_the_closed_form(x64, lengths, frame_at):
    arm = planar_arm(lengths, frame_at=frame_at)
    (qpos, *_), (qvel, *_) = motions(arm.num_joints)
    states, twists = link_states(arm, qpos, qvel), body_twists(arm, qpos, qvel)
    joint, velocity, angle, rate = np.zeros(2), np.zeros(2), 0.0, 0.0
    rounding = 1e-14 * max(1, arm.num_joints / 4) ** 2  # 10 roundings of speeds, which add up along the arm
    for i, length in enumerate(lengths):
        angle, rate = angle + qpos[i], rate + qvel[i]
        along, across = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
        reach = frame_at * length
        expected = {
            "position": [*(joint + reach * along) / sum(lengths), 0],
            "direction": [*along, 0],
            "linear_velocity": [*(velocity + reach * rate * across) / sum(lengths), 0],
            "angular_velocity": [0, 0, rate],
        }
        for field, values in expected.items():
            np.testing.assert_allclose(getattr(states, field)[i], values, atol=rounding, err_msg=field)
        in_link_frame = [velocity @ along, velocity @ across + reach * rate, 0]
        np.testing.assert_allclose(twists[i], [0, 0, rate, *in_link_frame], atol=rounding)
        joint, velocity = joint + length * along, velocity + length * rate * across


def test_states_at_rest_and_unnormalized():
    arm = panda()
    qpos = motions(7)[0][0].astype(np.float32)
    rest, still = link_states(arm, qpos), link_states(arm, qpos, np.zeros(7, np.float32))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-7), rest, still)  # one rounding
    assert not any(np.any(velocity) for velocity in (rest.linear_velocity, rest.angular_velocity))
    metres = link_states(arm, qpos, normalized=False)
    np.testing.assert_allclose(rest.position * arm.chain_length, metres.position, atol=1e-6)  # float32, 1 m
    points = candidate_points(rest)
    assert points.direction is None and points.angular_velocity is None
    np.testing.assert_array_equal(points.position, rest.position)


@pytest.mark.parametrize("function", [forward_kinematics, link_states, body_twists])
def test_a_batch_is_a_vmap_is_a_loop(function):
    """Batch axes come first, and broadcast."""
    arm = planar_arm([0.4, 0.6])
    motion = tuple(x.astype(np.float32) for x in motions(2))[: 1 if function is forward_kinematics else 2]
    mapped = jax.vmap(lambda *x: function(arm, *x))(*motion)
    batch = function(arm, motion[0][:, None], *(x[0] for x in motion[1:]))
    for k in range(POSES):
        one, first = function(arm, *(x[k] for x in motion)), function(arm, motion[0][k], *(x[0] for x in motion[1:]))
        jax.tree.map(lambda a, b, k=k: np.testing.assert_array_equal(a[k], b), mapped, one)
        jax.tree.map(lambda a, b, k=k: np.testing.assert_array_equal(a[k, 0], b), batch, first)


@pytest.mark.parametrize(
    ("function", "joints"), [(forward_kinematics, 3), (link_states, 3), (body_twists, 3), (link_states, LONG + 2)]
)
def test_jit_takes_the_arm_as_an_argument(function, joints):
    arm = load_mjcf(random_arms.random_arm(11, joints))
    (qpos, *_), (qvel, *_) = (x.astype(np.float32) for x in motions(joints))
    inputs = (qpos,) if function is forward_kinematics else (qpos, qvel)
    traced = []

    @jax.jit
    def jitted(arm, *inputs):
        traced.append(arm)
        return function(arm, *inputs)

    constant, compiled = function(arm, *inputs), jitted(arm, *inputs)
    # other constants, folded or not, and fused or not: a few float32 roundings of numbers up to 3
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-6), constant, compiled)
    longer = dataclasses.replace(arm, link_lengths=2 * arm.link_lengths)
    other = jitted(longer, *inputs)
    assert len(traced) == 1  # arms that differ in numbers share what was compiled
    if function is link_states:
        np.testing.assert_allclose(2 * other.position, constant.position, atol=2e-6)  # as above


@pytest.mark.parametrize("arm", [planar_arm([0.4, 0.6]), panda(locked=(2, 3, 4, 5, 6, 7))], ids=lambda arm: arm.name)
def test_float32_stays_float32_under_x64(x64, arm):
    q32 = jnp.ones(arm.num_joints, jnp.float32)
    results = forward_kinematics(arm, q32), link_states(arm, q32, q32), body_twists(arm, q32, q32)
    assert {x.dtype for x in jax.tree.leaves(results)} == {jnp.dtype("float32")}
    assert link_states(arm, q32.astype(jnp.float64)).position.dtype == jnp.float64


def test_integer_angles_are_accepted(unchecked):
    arm = planar_arm([0.4, 0.6])
    assert link_states(arm, np.array([0, 1])).position.dtype == jnp.float32  # pyright: ignore[reportArgumentType]


def test_annotated_shapes_are_checked_while_testing():
    with pytest.raises(jaxtyping.TypeCheckError, match="qvel"):
        link_states(planar_arm([0.4, 0.6]), np.zeros(2, np.float32), np.zeros(3, np.float32))


@pytest.mark.parametrize("shape", [(), (6,), (7, 1)])
def test_wrong_shapes_are_rejected(unchecked, shape):
    arm, good, bad = panda(), np.zeros(7, np.float32), np.zeros(shape, np.float32)
    for what, call in {
        "qpos": [
            lambda: forward_kinematics(arm, bad),
            lambda: link_states(arm, bad),
            lambda: body_twists(arm, bad, good),
        ],
        "qvel": [lambda: link_states(arm, good, bad), lambda: body_twists(arm, good, bad)],
    }.items():
        for function in call:
            with pytest.raises(
                ValueError, match=rf"^{what}: expected shape \[\.\.\., 7\] for panda, got {re.escape(str(shape))}$"
            ):
                function()


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    "arm",
    [
        panda(locked=(3, 6, 7)),
        load_mjcf(mujoco.MjModel.from_xml_string(torso()), tip=TORSO_TIPS),
    ],
    ids=lambda arm: arm.name,
)
def test_link_states_of_a_batch_at_rest_equal_link_states(arm):
    """1e-12: double precision."""
    qpos = np.random.default_rng(0).uniform(-3, 3, (3, arm.num_joints))
    batch, single = jax.jit(lambda q: resting_link_states(arm, q))(qpos.T), jax.jit(lambda q: link_states(arm, q))
    for pose, angles in enumerate(qpos):
        one = single(angles)
        jax.tree.map(lambda a, b, p=pose: np.testing.assert_allclose(a[..., p], b, atol=1e-12), batch, one)


def test_the_table_of_link_states_equals_link_states():
    arm = mimic.panda(locked=[3])
    qpos, qvel = np.random.default_rng(0).normal(size=(2, 3, 4, arm.num_joints))
    table = link_state_table(arm, qpos, qvel)
    one_by_one = jax.jit(lambda *motion: mimic.link_states(arm, *motion))(qpos, qvel)
    assert jax.tree.structure(table) == jax.tree.structure(one_by_one)
    for actual, values in zip(*map(jax.tree.leaves, (table, one_by_one)), strict=True):
        assert isinstance(actual, np.ndarray) and actual.dtype == np.float32
        np.testing.assert_allclose(actual, values, atol=1e-5)  # float32 against float64 that is rounded
