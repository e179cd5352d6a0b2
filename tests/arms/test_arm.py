"""The arms of the environments: what is simulated of them, and how strong they are."""

import dataclasses

import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm, effective_inertia, simulation_model, torque_scale


def test_simulation_model_keeps_only_what_moves():
    model = build_arm(ArmConfig(locked=(3, 6, 7))).model
    assert (model.nq, model.nu, model.ngeom, model.nsite) == (4, 0, 0, 0)
    assert simulation_model(model, ()).nq == 0
    assert np.all(effective_inertia(model, np.zeros(4)) > 0)


def test_the_largest_torque_takes_a_joint_to_twice_its_velocity_limit_in_a_step():
    """Of a rod of 1 kg/m that turns about its end, with an armature of 0.02 kg m^2: in closed form."""
    length, dt, action_scale = 0.5, 0.1, 1.5
    arm = build_arm(ArmConfig(model="planar", link_lengths=[length]))
    assert np.isinf(arm.embodiment.torque_limit).all()
    inertia = length**3 / 3 + 0.02
    expected = action_scale * 2 * arm.embodiment.velocity_limit * inertia / dt
    np.testing.assert_allclose(torque_scale(arm, action_scale, dt), expected, rtol=1e-6)  # float32


@pytest.mark.parametrize("locked", [(), (3, 6, 7)])
def test_no_action_asks_for_more_than_the_torque_limit(locked):
    """Some joints of a Panda reach it at twice the default scale, all of them at a hundred times that."""
    arm = build_arm(ArmConfig(locked=locked))
    limit = arm.embodiment.torque_limit
    unlimited = dataclasses.replace(arm, embodiment=dataclasses.replace(arm.embodiment, torque_limit=np.inf * limit))
    for action_scale in (1.0, 2.0, 100.0):
        free = torque_scale(unlimited, action_scale, 0.1)
        np.testing.assert_array_equal(torque_scale(arm, action_scale, 0.1), np.minimum(free, limit))
    assert np.all(torque_scale(arm, 100.0, 0.1) == limit)
