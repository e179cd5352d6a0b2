"""A learner in its world as a MuJoCo model: gravity, payload, stops, and links that touch each other and the floor.

MJX simulates it for checks of the environment, and C MuJoCo as a virtual robot. Friction is no part of a model: it is
`joint_control.friction_torque`, among the applied torques.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import Arm
from mimic.arms.capsules import Capsules
from mimic.arms.model_tree import quaternion
from mimic.arms.pose_limits import pose_limits
from mimic.arms.simulation_model import simulation_spec
from mimic.control.joint_control import PERIOD
from mimic.physics.plant import GRAVITY, end_of_last_link
from mimic.physics.world import WorldConfig

PAYLOAD, FLOOR = "payload", "floor"
_SPHERE = 1e-6  # m, of the axis of a capsule
_FLOOR_SIZE = 5.0  # m, as drawn
_NO_CONTACT = {"contype": 0, "conaffinity": 0, "mass": 0.0}  # only the pairs that are named touch

_Place = tuple[np.ndarray, np.ndarray]  # rotation and origin in the world of a model


class MujocoWorld(NamedTuple):
    """A model of a learner in its world.

    Attributes:
      model: with a body for the payload at the end of the last link, without mass. Gravity is that of a gravity error
        of 1: nothing is compensated. The joints are those of the arm, in its order; a step is a period of the inner
        loop.
      body_joint: [bodies] index of the joint that moves each body; -1 for the payload and what no joint moves.
      payload: index of the body of the payload.
      along: [3] direction of the last link, in the frame of the payload.
    """

    model: mujoco.MjModel
    body_joint: np.ndarray
    payload: int
    along: Float[np.ndarray, "3"]


class LoadedFields(NamedTuple):
    """Fields of a model that the load of an episode changes, with their names in MuJoCo."""

    gravity: Float[Any, "3"]
    body_mass: Float[Any, " bodies"]
    body_inertia: Float[Any, "bodies 3"]
    body_ipos: Float[Any, "bodies 3"]


def mujoco_world(
    arm: Arm, world: WorldConfig, capsules: Capsules | None = None, pairs: Sequence[tuple[int, int]] = ()
) -> MujocoWorld:
    """Makes the model.

    Args:
      arm: the learner.
      world: its gravity, stops and contacts; what is drawn for each episode is not set.
      capsules: shapes of the links, for contacts; needed where `world.contacts`.
      pairs: indices of the capsules that can collide with each other, see `colliding_pairs`.
    """
    assert capsules is not None or not world.contacts
    spec = simulation_spec(arm.model, arm.embodiment.joint_names)
    spec.compiler.fusestatic = False  # the payload has a body of its own
    spec.option.timestep, spec.option.integrator = PERIOD, mujoco.mjtIntegrator.mjINT_EULER
    spec.option.gravity = [0.0, 0.0, -GRAVITY]
    spec.option.disableflags = disabled(gravity=world.gravity, stops=world.stops, contacts=world.contacts)
    _set_stops(spec, arm)
    places = _places(arm)
    along = _add_payload(spec, arm, places)
    if capsules is not None:
        _add_contacts(spec, arm, capsules, pairs, places, world.floor_height)
    model = spec.compile()
    body_joint = np.full(model.nbody, -1)
    body_joint[model.jnt_bodyid] = np.arange(model.njnt)
    return MujocoWorld(model, body_joint, model.body(PAYLOAD).id, along)


def disabled(*, gravity: bool, stops: bool, contacts: bool) -> int:
    """`disableflags` of a model, for what its world has."""
    flags = mujoco.mjtDisableBit
    features = {
        flags.mjDSBL_GRAVITY: gravity,
        flags.mjDSBL_LIMIT: stops,
        flags.mjDSBL_CONTACT: contacts,
        flags.mjDSBL_CONSTRAINT: stops or contacts,
    }
    return sum(int(flag) for flag, is_there in features.items() if not is_there)


def loaded_fields(
    world: MujocoWorld, gravity_error: Any, link_mass: Any, payload: Any, payload_lever: Any, xp: Any
) -> LoadedFields:
    """The fields of a model for an episode, see `Draw`.

    Args:
      world: the model.
      gravity_error, link_mass, payload, payload_lever: of the episode.
      xp: array library, `numpy` or `jax.numpy`.
    """
    model = world.model
    is_payload = np.arange(model.nbody) == world.payload
    factor = xp.where(world.body_joint < 0, 1.0, link_mass[world.body_joint])
    return LoadedFields(
        gravity=gravity_error * model.opt.gravity,
        body_mass=xp.where(is_payload, payload, factor * model.body_mass),
        body_inertia=factor[:, None] * model.body_inertia,
        body_ipos=xp.where(is_payload[:, None], payload_lever * world.along, model.body_ipos),
    )


def _set_stops(spec: mujoco.MjSpec, arm: Arm) -> None:
    for name, *limit in zip(arm.embodiment.joint_names, *pose_limits(arm.embodiment, float), strict=True):
        if np.all(np.isfinite(limit)):  # the others rotate without end
            spec.joint(name).limited, spec.joint(name).range = mujoco.mjtLimited.mjLIMITED_TRUE, limit


def _places(arm: Arm) -> list[_Place]:
    """Those of the world, and then of the body of each joint, at angles 0."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(arm.model, data)
    return [(data.xmat[body].reshape(3, 3).copy(), data.xpos[body].copy()) for body in (0, *arm.model.jnt_bodyid)]


def _in_body(arm: Arm, place: _Place, point: np.ndarray) -> np.ndarray:
    """A point of the base frame at angles 0, in the frame of a body."""
    rotation, origin = place
    T_world_base = arm.T_world_base
    return rotation.T @ (T_world_base[:3, :3] @ point + T_world_base[:3, 3] - origin)


def _body(spec: mujoco.MjSpec, arm: Arm, joint: int) -> Any:
    """The body of a joint; the world for -1."""
    return spec.worldbody if joint < 0 else spec.joint(arm.embodiment.joint_names[joint]).parent


def _add_payload(spec: mujoco.MjSpec, arm: Arm, places: list[_Place]) -> np.ndarray:
    """Adds the body of the payload at the end of the last link; returns the link's direction in its frame."""
    tip, along = end_of_last_link(arm)
    joint = arm.embodiment.link_joint[-1]
    place = places[joint + 1]
    body = _body(spec, arm, joint).add_body(name=PAYLOAD, pos=_in_body(arm, place, tip))
    body.explicitinertial, body.mass, body.ipos, body.inertia = True, 0.0, [0.0] * 3, [0.0] * 3
    return place[0].T @ arm.T_world_base[:3, :3] @ along


def _add_contacts(
    spec: mujoco.MjSpec,
    arm: Arm,
    capsules: Capsules,
    pairs: Sequence[tuple[int, int]],
    places: list[_Place],
    floor_height: float,
) -> None:
    """Adds the capsules as geoms, their pairs, and a floor for all but those near the base.

    These are the pairs of the safety layer's clearance. The floor is a plane of the base frame, as there.
    """
    for index, joint in enumerate(capsules.joint):
        ends = [_in_body(arm, places[joint + 1], np.asarray(end[index])) for end in (capsules.start, capsules.end)]
        shape = _shape(ends, float(capsules.radius[index]))
        _body(spec, arm, joint).add_geom(**shape, name=f"capsule{index}", **_NO_CONTACT)
    R_world_base = arm.T_world_base[:3, :3]
    spec.worldbody.add_geom(
        name=FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[_FLOOR_SIZE, _FLOOR_SIZE, 0.1],
        pos=R_world_base @ [0, 0, floor_height] + arm.T_world_base[:3, 3], quat=quaternion(R_world_base), **_NO_CONTACT,
    )  # fmt: skip
    for i, j in pairs:
        spec.add_pair(geomname1=f"capsule{i}", geomname2=f"capsule{j}")
    for index, is_near_base in enumerate(capsules.near_base):
        if not is_near_base:
            spec.add_pair(geomname1=FLOOR, geomname2=f"capsule{index}")


def _shape(ends: list[np.ndarray], radius: float) -> dict[str, object]:
    if np.linalg.norm(ends[1] - ends[0]) < _SPHERE:
        return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "pos": ends[0], "size": [radius, 0, 0]}
    return {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "fromto": [*ends[0], *ends[1]], "size": [radius, 0, 0]}
