"""Motions in which links touch each other or the floor."""

import copy
from collections.abc import Callable

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from mujoco.rollout import Rollout

from mimic.arms.arm import Arm, ArmConfig, arm_spec, build_arm
from mimic.arms.capsules import Capsules
from mimic.arms.embodiment import Embodiment
from mimic.arms.mujoco_chain import data_at_zero
from mimic.control.clearance import clearance
from mimic.metric.capsule_distances import clearance_constants

_SENSOR = "contacts of any geoms"
_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_TIME = 1  # numbers of a state before its qpos
_OFF = mujoco.mjtDisableBit
_NO_FORCES = (  # of a step, whose contacts alone count
    _OFF.mjDSBL_ACTUATION | _OFF.mjDSBL_AUTORESET | _OFF.mjDSBL_DAMPER | _OFF.mjDSBL_EQUALITY
    | _OFF.mjDSBL_FRICTIONLOSS | _OFF.mjDSBL_GRAVITY | _OFF.mjDSBL_LIMIT | _OFF.mjDSBL_SPRING
)  # fmt: skip


def smallest_clearances(
    arm: Embodiment, capsules: Capsules, qpos: Float[np.ndarray, "motions time joints"], floor_height: float = 0.0
) -> Float[np.ndarray, " motions"]:
    """The smallest clearance of each motion [m], negative where capsules of links touch each other or the floor.

    Args:
      arm: embodiment of the joints.
      capsules: from `fit_capsules`, of the same arm. They contain its shapes, so that a small negative clearance need
        not be a contact of the shapes.
      qpos: joint angles [rad].
      floor_height: see `WorldConfig`.
    """
    constants = clearance_constants(arm, capsules, floor_height)
    return np.stack([clearance(np.asarray(motion, np.float32), constants).min() for motion in qpos])


def make_contacts(
    config: ArmConfig, limits: str = "none"
) -> Callable[[Float[np.ndarray, "poses joints"]], Bool[np.ndarray, " poses"]]:
    """Makes the function from joint angles [rad] to whether collision geoms of the arm's model touch, by MuJoCo.

    Meshes count as their convex hulls. Bodies that are joined, and those that touch in the home pose, are left out.

    Raises:
      ValueError: what `build_arm` rejects.
    """
    arm, spec = build_arm(config, limits), arm_spec(config)
    model = spec.compile()
    data, address = _at_rest(model, arm)
    data.qpos[address] = arm.embodiment.home
    mujoco.mj_fwdPosition(model, data)
    names = {}
    for body in spec.bodies:
        body.name = names[body.id] = body.name or f"body {body.id} of {len(spec.bodies)}"
    touching = model.geom_bodyid[data.contact.geom[data.contact.dist < 0]]
    for one, other in {tuple(sorted(pair)) for pair in touching.tolist()}:
        spec.add_exclude(bodyname1=names[one], bodyname2=names[other])
    # A sensor that counts contacts of any geoms: MuJoCo then computes a motion without Python's lock.
    any_geom = mujoco.mjtObj.mjOBJ_UNKNOWN
    data_field, no_reduction, one_slot = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1
    spec.add_sensor(
        name=_SENSOR, type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=any_geom, reftype=any_geom,
        intprm=[data_field, no_reduction, one_slot],
    )  # fmt: skip
    model = spec.compile()
    model.geom_margin[:] = model.pair_margin[:] = 0.0
    model.opt.disableflags = _NO_FORCES
    start, address = _at_rest(model, arm)
    state = np.zeros(mujoco.mj_stateSize(model, _STATE))
    mujoco.mj_getState(model, start, state, _STATE)
    column = model.sensor(_SENSOR).adr[0]

    def contacts(qpos: np.ndarray) -> np.ndarray:
        if not len(qpos):  # MuJoCo does not expect that
            return np.zeros(0, bool)
        states = np.tile(state, (len(qpos), 1))
        states[:, _TIME + address] = qpos
        with Rollout(nthread=1) as rollout:
            sensors = rollout.rollout(model, [copy.copy(start)], states, nstep=1)[1]
        return sensors[:, 0, column] > 0

    return contacts


def _at_rest(model: mujoco.MjModel, arm: Arm) -> tuple[mujoco.MjData, np.ndarray]:
    """The model in its zero pose with locked joints at their angles, and where in qpos the arm's joints are."""
    data = data_at_zero(model)
    for name, angle in arm.locked.items():
        data.qpos[model.joint(name).qposadr[0]] = angle
    return data, np.array([model.joint(name).qposadr[0] for name in arm.embodiment.joint_names])


def touching_line(clearances: Float[np.ndarray, " motions"]) -> str:
    """What `smallest_clearances` tell, as a sentence."""
    touching, smallest = np.flatnonzero(clearances < 0), f"{1e3 * clearances.min():.0f} mm"
    if not len(touching):
        return f"links touch neither each other nor the floor; smallest clearance: {smallest}"
    shown = ", ".join(map(str, touching[:_SHOWN])) + (", ..." if len(touching) > _SHOWN else "")
    return (
        f"warning: links touch each other or the floor in {len(touching)} of {len(clearances)} demonstrations: "
        f"{shown}; smallest clearance: {smallest}"
    )


_SHOWN = 8  # numbers of motions
