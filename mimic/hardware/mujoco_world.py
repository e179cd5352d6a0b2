"""A learner in its world as a MuJoCo model: gravity, payload, stops, and links that touch each other and the floor."""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import Arm
from mimic.arms.capsules import Capsules
from mimic.arms.simulation_model import simulation_spec
from mimic.control.joint_control import PERIOD
from mimic.envs.world import WorldConfig
from mimic.hardware.plant import GRAVITY, end_of_last_link
from mimic.retargeting.costs import changing_pairs
from mimic.retargeting.pose import pose_limits

PAYLOAD, FLOOR = "payload", "floor"
_NO_MASS = 1e-6  # kg, of the body of a payload before its mass is set; MuJoCo needs one
_FLOOR_SIZE = 5.0  # m


class MujocoWorld(NamedTuple):
    """A model of a learner in its world.

    Attributes:
      model: with a body for the payload at the end of the last link, without mass. Gravity is that of a gravity error
        of 1: nothing is compensated.
      moving: [joints] index of the body that each joint moves.
      payload: index of the body of the payload.
      tip, along: [3] its position without a lever, and the direction of the lever, in the frame of its parent.
    """

    model: mujoco.MjModel
    moving: np.ndarray
    payload: int
    tip: Float[np.ndarray, "3"]
    along: Float[np.ndarray, "3"]


def mujoco_world(arm: Arm, world: WorldConfig, capsules: Capsules | None = None) -> MujocoWorld:
    """Makes the model.

    Args:
      arm: the learner.
      world: its stops and contacts; what is drawn for each episode is not set.
      capsules: shapes of the links, for contacts; needed where `world.contacts`.
    """
    spec = simulation_spec(arm.model, arm.embodiment.joint_names)
    spec.compiler.fusestatic = False  # the payload has a body of its own
    spec.option.timestep, spec.option.integrator = PERIOD, mujoco.mjtIntegrator.mjINT_EULER
    spec.option.gravity = [0.0, 0.0, -GRAVITY if world.gravity else 0.0]
    disabled = 0 if world.stops or world.contacts else mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    spec.option.disableflags = int(disabled) | (0 if world.contacts else int(mujoco.mjtDisableBit.mjDSBL_CONTACT))
    if world.stops:
        limits = np.stack(pose_limits(arm.embodiment, float), axis=1)
        for name, limit in zip(arm.embodiment.joint_names, limits, strict=True):
            if np.all(np.isfinite(limit)):  # the others rotate without end
                spec.joint(name).limited, spec.joint(name).range = mujoco.mjtLimited.mjLIMITED_TRUE, limit
    tip, along = _tip_in_last_body(arm)
    last = [body for body in spec.bodies if body.name != "world"][-1]
    payload = last.add_body(name=PAYLOAD, pos=tip)
    payload.explicitinertial, payload.mass, payload.ipos = True, _NO_MASS, [0.0] * 3
    payload.inertia = [_NO_MASS] * 3
    if world.contacts:
        assert capsules is not None
        _add_contacts(spec, arm, capsules)
    model = spec.compile()
    moving = np.array(model.jnt_bodyid)
    return MujocoWorld(model, moving, model.body(PAYLOAD).id, tip, along)


def _tip_in_last_body(arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """End and direction of the last link in the frame of the last body."""
    tip, along = end_of_last_link(arm)
    pose, data = arm.T_world_base, mujoco.MjData(arm.model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(arm.model, data)
    rotation, origin = data.xmat[-1].reshape(3, 3), data.xpos[-1]
    tip = pose[:3, :3] @ tip + pose[:3, 3]
    return rotation.T @ (tip - origin), rotation.T @ pose[:3, :3] @ along


def _add_contacts(spec: mujoco.MjSpec, arm: Arm, capsules: Capsules) -> None:
    """Adds the capsules as geoms, pairs whose distance joints change, and a floor for all but those near the base."""
    pose, data = arm.T_world_base, mujoco.MjData(arm.model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(arm.model, data)
    bodies = [spec.worldbody, *(spec.joint(name).parent for name in arm.embodiment.joint_names)]
    poses = [(np.eye(3), np.zeros(3))]
    poses += [(data.xmat[body].reshape(3, 3), data.xpos[body]) for body in arm.model.jnt_bodyid]
    for index, joint in enumerate(capsules.joint):
        rotation, origin = poses[joint + 1]
        ends = [
            rotation.T @ (pose[:3, :3] @ end[index] + pose[:3, 3] - origin) for end in (capsules.start, capsules.end)
        ]
        bodies[joint + 1].add_geom(**_shape(ends, float(capsules.radius[index])), name=f"capsule{index}", **_NO_CONTACT)
    spec.worldbody.add_geom(
        name=FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[_FLOOR_SIZE, _FLOOR_SIZE, 0.1], **_NO_CONTACT
    )
    for (i, j), changes in zip(capsules.pairs, changing_pairs(arm.embodiment, capsules), strict=True):
        if changes:
            spec.add_pair(geomname1=f"capsule{i}", geomname2=f"capsule{j}")
    for index, is_near_base in enumerate(capsules.near_base):
        if not is_near_base:
            spec.add_pair(geomname1=FLOOR, geomname2=f"capsule{index}")


_NO_CONTACT = {"contype": 0, "conaffinity": 0, "mass": 0.0}  # only the pairs that are named touch


def _shape(ends: list[np.ndarray], radius: float) -> dict[str, object]:
    if np.linalg.norm(ends[1] - ends[0]) < 1e-9:
        return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "pos": ends[0], "size": [radius, 0, 0]}
    return {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "fromto": [*ends[0], *ends[1]], "size": [radius, 0, 0]}
