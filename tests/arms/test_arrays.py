"""The arrays of an arm: slots, masks, errors, and the axes that Denavit and Hartenberg's parameters fear."""

import dataclasses

import jax
import mujoco
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS, arm_arrays, masked_arrays
from mimic.metric.kinematics import link_states
from tests.helpers import random_arms
from tests.helpers.array_cases import (
    acceleration,
    arm_of,
    assert_near,
    looped,
    padded,
    random_motion,
    torque_of_arm,
    unrolled,
)

_BODY = '<inertial pos="0.1 0.02 -0.03" mass="{}" diaginertia="0.002 0.003 0.004"/>'
_SITE = '<site name="tip" type="sphere" pos="0.2 0.1 0.05"/>'


def from_axes(axes, offsets, size=1):
    """A serial arm with these axes and offsets of bodies, `size` joints in each body."""
    bodies = ""
    for body, offset in enumerate(offsets):
        own = range(body * size, (body + 1) * size)
        joints = "".join(
            f'<joint name="joint{i + 1}" axis="{" ".join(map(repr, axes[i]))}" damping="0.1" armature="0.01"/>'
            for i in own
        )
        bodies += f'<body pos="{" ".join(map(str, offset))}">{_BODY.format(1 + body)}{joints}'
    xml = f"<worldbody>{bodies}{_SITE}{'</body>' * len(offsets)}</worldbody>"
    return mujoco.MjModel.from_xml_string(f'<mujoco model="arm"><compiler angle="radian"/>{xml}</mujoco>')


def tilted(*angles):
    return [(0.0, float(np.sin(angle)), float(np.cos(angle))) for angle in angles]


_STEPS = [(0.0, 0.0, 0.3), (0.25, 0.1, 0.05), (-0.1, 0.3, 0.1), (0.2, 0.0, 0.3)]
_ALONG = [(0.0, 0.0, 0.3)] * 4
HARD_AXES = {
    "almost parallel, 1e-5 rad": from_axes(tilted(0, 1e-5, 0, -1e-5), _STEPS),
    "almost parallel, 1e-9 rad": from_axes(tilted(0, 1e-9, 0, -1e-9), _STEPS),
    "parallel": from_axes(tilted(0, 0, 0, 0), _STEPS),
    "opposite": from_axes(tilted(0, np.pi, 0, np.pi - 1e-9), _STEPS),
    "coincident": from_axes(tilted(0, 0, 0, 0), _ALONG),
    "almost coincident, 1e-9 rad": from_axes(tilted(0, 1e-9, 1e-9, -1e-9), _ALONG),
    "coincident, then normal": from_axes([*tilted(0, 0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)], _ALONG),
    "two joints in a body": from_axes([(0.0, 0.0, 1.0), (0.6, 0.8, 0.0)] * 4, _STEPS, size=2),
    "equal joints in a body": from_axes(
        [*tilted(0.3), *tilted(0.3), (1.0, 0.0, 0.0), *tilted(0.2)], _STEPS[:2], size=2
    ),
}


# Of all cases, so that each is compiled once.
FORMS = [jax.jit(form) for form in (unrolled, looped)]
TORQUE, STATES = jax.jit(torque_of_arm), jax.jit(link_states)


@pytest.mark.slow_for("almost parallel, 1e-5 rad")
@pytest.mark.parametrize("name", HARD_AXES)
def test_hard_axes_move_as_in_mujoco(x64, name):
    """To 1e-11: rounding of 1e-16 a step, and axes at less than 1e-12 rad count as parallel."""
    arm = arm_of(HARD_AXES[name])
    arrays, rng = arm_arrays(arm), np.random.default_rng(0)
    for qpos, qvel, qacc, torque in [random_motion(arm, rng) for _ in range(3)]:
        rows = padded(qpos), padded(qvel)
        expected = acceleration(HARD_AXES[name], qpos, qvel, torque)
        for form in FORMS:
            assert_near(np.asarray(form(arrays, *rows, padded(torque))), padded(expected), 1e-11)
        assert_near(np.asarray(TORQUE(arrays, *rows, padded(qacc))), padded(torque), 1e-11)
        data = random_arms.posed(HARD_AXES[name], qpos, qvel)
        names = arm.embodiment.link_names
        reference = random_arms.links(HARD_AXES[name], data, names)
        states, unit = STATES(arrays, *rows), arm.embodiment.chain_length
        scale = {"position": unit, "linear_velocity": unit}
        for field, values in reference.items():
            actual = np.asarray(getattr(states, field))[: len(names)] * scale.get(field, 1)
            np.testing.assert_allclose(actual, values, rtol=0, atol=1e-11 * max(1, np.abs(values).max()))


def test_empty_slots_are_locked_and_have_no_mass():
    arm = build_arm(ArmConfig(model="planar", link_lengths=[0.4, 0.3]))
    arrays = arm_arrays(arm)
    assert arrays.is_free.tolist() == [1, 1] + [0] * (MAX_JOINTS - 2)
    assert not arrays.first_moment[2:].any() and not arrays.second_moment[2:].any()
    np.testing.assert_array_equal(arrays.link_length, np.pad(arm.embodiment.link_lengths, (0, MAX_LINKS - 2)))
    assert arrays.chain_length == pytest.approx(0.7)
    assert set(arrays.link_joint[2:]) == {-1}
    assert np.all(np.isinf(arrays.torque_limit[:2])) and np.all(np.isfinite(arrays.torque_limit[2:]))
    others = dataclasses.replace(arrays, torque_limit=arrays.damping)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(others))


def test_planar_arms_have_no_offsets_but_their_lengths():
    """The x-axes of parallel joints run along the links."""
    arrays = arm_arrays(build_arm(ArmConfig(model="planar", link_lengths=[0.4, 0.3, 0.2])))
    np.testing.assert_array_equal(arrays.twist, np.tile([1.0, 0.0], (MAX_JOINTS, 1)))
    np.testing.assert_allclose(arrays.offset[:3], [[0, 0], [0.4, 0], [0.3, 0]], atol=1e-15)  # rounding
    np.testing.assert_allclose(arrays.second_moment[:, 3:], 0, atol=1e-15)


def test_a_tree_is_rejected():
    with pytest.raises(ValueError, match=r"^panda_pair: expected a serial arm, got a tree of 2 chains$"):
        arm_arrays(build_arm(ArmConfig(model="panda_pair")))


def test_too_many_joints_are_rejected():
    arm = build_arm(ArmConfig(model="planar", link_lengths=[0.1] * 9))
    with pytest.raises(ValueError, match=r"^planar9: expected at most 8 joints and 12 links, got 9 and 9$"):
        arm_arrays(arm)


def test_locked_joints_of_a_config_keep_their_slots_and_angles():
    """Names, numbers, and angles other than home; the links are those of the arm without these joints."""
    config = ArmConfig(locked={"joint2": 0.4, "joint6": -0.3})
    arrays, names = masked_arrays(config, "none", "kept")
    assert names == tuple(f"joint{i}" for i in range(1, 8))
    np.testing.assert_array_equal(arrays.is_free, [1, 0, 1, 1, 1, 0, 1, 0])
    np.testing.assert_allclose(arrays.home[[1, 5]], [0.4, -0.3])
    fewer = arm_arrays(build_arm(config))
    motion = np.array([0.3, -0.5, 0.7, -1.2, 0.4])
    with_slots = arrays.home.copy()
    with_slots[[0, 2, 3, 4, 6]] = motion
    own, expected = STATES(arrays, with_slots), STATES(fewer, padded(motion))
    assert own.direction is not None and expected.direction is not None
    np.testing.assert_allclose(own.position, expected.position, atol=1e-6)
    np.testing.assert_allclose(own.direction, expected.direction, atol=1e-6)
