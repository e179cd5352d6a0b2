"""Arms as the environments use them: the simulation model and the maximum torques."""

import dataclasses

import mujoco
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm, effective_inertia, simulation_model, torque_scale


def test_simulation_model_has_only_what_moves():
    model = build_arm(ArmConfig(locked=(3, 6, 7))).model
    assert (model.nq, model.nu, model.ngeom, model.nsite) == (4, 0, 0, 0)
    assert simulation_model(model, ()).nq == 0
    assert np.all(effective_inertia(model, np.zeros(4)) > 0)


def test_the_maximum_torque_takes_a_joint_to_twice_its_velocity_limit_in_a_step():
    """Closed form for a rod of 1 kg/m that rotates about its end, with an armature of 0.02 kg m^2."""
    length, dt, action_scale = 0.5, 0.1, 1.5
    arm = build_arm(ArmConfig(model="planar", link_lengths=[length]))
    assert np.isinf(arm.embodiment.torque_limit).all()
    inertia = length**3 / 3 + 0.02
    expected = action_scale * 2 * arm.embodiment.velocity_limit * inertia / dt
    np.testing.assert_allclose(torque_scale(arm, action_scale, dt), expected, rtol=1e-6)  # float32


@pytest.mark.parametrize("locked", [(), (3, 6, 7)])
def test_no_action_exceeds_the_torque_limit(locked):
    """Some joints of a Panda reach the limit at an action scale of 2, all of them at 100."""
    arm = build_arm(ArmConfig(locked=locked))
    limit = arm.embodiment.torque_limit
    unlimited = dataclasses.replace(arm, embodiment=dataclasses.replace(arm.embodiment, torque_limit=np.inf * limit))
    for action_scale in (1.0, 2.0, 100.0):
        free = torque_scale(unlimited, action_scale, 0.1)
        np.testing.assert_array_equal(torque_scale(arm, action_scale, 0.1), np.minimum(free, limit))
    assert np.all(torque_scale(arm, 100.0, 0.1) == limit)


TILTED = """<mujoco><worldbody><body name="base" pos="1 2 3" quat="0.9 0.3 0.1 0.2"><body pos="0 0 .2">
<joint name="a" axis="0 0 1"/><geom size=".1"/><body pos="0 0 .3"><joint name="b" axis="0 1 0" ref="0.5"/>
<geom size=".1"/></body></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("locked", [[], ["a"], ["b"]])
def test_the_base_frame_lies_where_the_joints_have_their_places_in_the_model(tmp_path, locked):
    """One joint alone does not tell where it lies."""
    (tmp_path / "tilted.xml").write_text(TILTED)
    arm = build_arm(ArmConfig(model=str(tmp_path / "tilted.xml"), locked=locked))
    rotation, origin = arm.T_world_base[:3, :3], arm.T_world_base[:3, 3]
    data = mujoco.MjData(arm.model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(arm.model, data)
    np.testing.assert_allclose(origin, [1, 2, 3])
    np.testing.assert_allclose(arm.embodiment.joint_anchor @ rotation.T + origin, data.xanchor, atol=1e-12)
    np.testing.assert_allclose(arm.embodiment.joint_axis @ rotation.T, data.xaxis, atol=1e-12)


def test_rotor_inertia_and_damping_by_joint():
    model = build_arm(ArmConfig(armature={"joint7": 0.5}, damping={"joint1": 7, "joint3": 8}, locked=["joint3"])).model
    plain = build_arm(ArmConfig(locked=["joint3"])).model
    np.testing.assert_allclose(model.dof_armature, [*plain.dof_armature[:-1], 0.5])
    np.testing.assert_allclose(model.dof_damping, [7, *plain.dof_damping[1:]])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"joint8": 1}, "armature: unknown joint 'joint8'; valid are joint1, .*; did you mean joint"),
        ({"joint1": -1}, "armature: expected a number from 0 to 10000, or a mapping .* got {'joint1': -1}"),
        ([0.1], r"armature: expected a number from 0 to 10000, or a mapping from names to such numbers, got \[0.1\]"),
        ("x", "armature: expected a number"),
        (None, "armature: expected a number, or a mapping from joints to numbers, got null"),
    ],
)
def test_bad_rotor_inertia(values, message):
    with pytest.raises(ValueError, match=message):
        build_arm(ArmConfig(armature=values))


def test_a_name_is_no_config():
    with pytest.raises(
        ValueError, match=r"config: expected an ArmConfig, as of ArmConfig\(model='panda'\), got 'panda'"
    ):
        build_arm("panda")  # type: ignore[arg-type]
