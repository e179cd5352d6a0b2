"""The model of a learner in its world, against one that is made in another way."""

import copy

import mujoco
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.capsules import fit_capsules
from mimic.control.clearance import clearance
from mimic.metric.capsule_distances import clearance_constants
from mimic.physics.mujoco_world import disabled, loaded_fields, mujoco_world
from mimic.physics.world import WorldConfig
from tests.helpers.array_cases import acceleration
from tests.physics.test_inner_loop import draw_for, make_arm_and_plant, mujoco_model

TILTED = """<mujoco><worldbody><body name="base" pos="1 2 3" quat="0.9 0.3 0.1 0.2">
<body pos="0 0 .2"><joint name="a" axis="0 0 1"/><geom type="capsule" fromto="0 0 0 0 0 .3" size=".05"/>
<body pos="0 0 .3"><joint name="b" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".05"/>
</body></body></body></worldbody></mujoco>"""


def loaded(world, draw) -> mujoco.MjModel:
    """The model of an episode in C MuJoCo."""
    model, mass = copy.copy(world.model), np.asarray(draw.link_mass)
    error, payload, lever = (float(x) for x in (draw.gravity_error, draw.payload, draw.payload_lever))
    fields = loaded_fields(world, error, mass, payload, lever, np)
    model.opt.gravity[:] = fields.gravity
    model.body_mass[:], model.body_inertia[:], model.body_ipos[:] = fields[1:]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def test_a_load_is_that_of_a_payload_within_the_last_body():
    """A point mass: no inertia of its own. What is left is rounding."""
    arm, _ = make_arm_and_plant()
    draw, rng = draw_for(arm.embodiment.num_joints), np.random.default_rng(0)
    ours = loaded(mujoco_world(arm, WorldConfig(gravity=True)), draw)
    qpos, qvel = rng.normal(size=(2, arm.embodiment.num_joints))
    expected = acceleration(mujoco_model(arm, draw), qpos, qvel, 0)
    np.testing.assert_allclose(acceleration(ours, qpos, qvel, 0), expected, rtol=1e-9, atol=1e-9)


def test_gravity_is_vertical_and_the_floor_is_that_of_the_base(tmp_path):
    """Where the base is tilted, too; the floor is the one of the safety layer and of the costs."""
    floor_height = -0.3
    (tmp_path / "tilted.xml").write_text(TILTED)
    config = ArmConfig(model=str(tmp_path / "tilted.xml"), base="base")
    arm, capsules, qpos = build_arm(config), fit_capsules(config), np.array([0.4, 1.2])
    model = mujoco_world(arm, WorldConfig(gravity=True, contacts=True, floor_height=floor_height), capsules).model
    plain = copy.copy(arm.model)
    plain.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    np.testing.assert_allclose(acceleration(model, qpos, 0, 0), acceleration(plain, qpos, 0, 0), rtol=1e-9)
    model.pair_margin[:] = 10.0  # reports distances, too
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    assert not capsules.pairs  # each contact is one with the floor
    expected = clearance(qpos, clearance_constants(arm.embodiment, capsules, floor_height))
    assert min(data.contact.dist) == pytest.approx(float(expected), abs=2e-4)


def test_what_a_world_lacks_is_disabled():
    flags = mujoco.mjtDisableBit
    assert disabled(gravity=True, stops=True, contacts=True) == 0
    assert disabled(gravity=True, stops=True, contacts=False) == flags.mjDSBL_CONTACT
    assert disabled(gravity=True, stops=False, contacts=True) == flags.mjDSBL_LIMIT
    none = flags.mjDSBL_GRAVITY | flags.mjDSBL_LIMIT | flags.mjDSBL_CONTACT | flags.mjDSBL_CONSTRAINT
    assert disabled(gravity=False, stops=False, contacts=False) == none
