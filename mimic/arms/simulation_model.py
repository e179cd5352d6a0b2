"""The lean MuJoCo model that simulates an arm: bodies, inertias and the free joints, nothing else."""

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

_IGNORED = (
    mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_GRAVITY
)


def simulation_model(
    source: mujoco.MjModel, joint_names: tuple[str, ...], locked: Mapping[str, float] | None = None
) -> mujoco.MjModel:
    """The bodies, inertias and named joints of a model and nothing else.

    No geoms, actuators, constraints, contacts or gravity. Bodies that no remaining joint moves are fused into their
    parents.

    Args:
      source: any model.
      joint_names: hinges to keep.
      locked: angle [rad] of joints that are removed, by name; other joints are removed at their zero.
    """
    locked = locked or {}
    spec = mujoco.MjSpec()
    spec.compiler.fusestatic = True
    spec.compiler.autolimits = False
    spec.compiler.degree = False  # the reference angles below are in radians
    spec.option.disableflags = int(_IGNORED)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    bodies = {0: spec.worldbody}
    for body_id in range(1, source.nbody):
        body = source.body(body_id)
        position, quaternion = np.array(body.pos), np.array(body.quat)
        joint_ids = range(source.body_jntadr[body_id], source.body_jntadr[body_id] + source.body_jntnum[body_id])
        kept = []  # hinges with their anchors and axes
        for joint in map(source.joint, joint_ids):
            if joint.name in joint_names:
                kept.append((joint, joint.pos, joint.axis))
            elif joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE:  # a removed joint turns its body for good
                angle = locked.get(joint.name, 0.0) - float(source.qpos0[joint.qposadr[0]])
                position, quaternion = _turned(position, quaternion, joint, angle)
                kept = [(other, *_turned_back(*line, joint, angle)) for other, *line in kept]
        bare = bodies[int(source.body_parentid[body_id])].add_body(pos=position, quat=quaternion)
        bodies[body_id] = bare
        if source.body_mass[body_id] > 0:
            bare.explicitinertial = True
            bare.mass, bare.ipos, bare.iquat = float(body.mass[0]), body.ipos, body.iquat
            bare.inertia = body.inertia
        for joint, anchor, axis in kept:
            bare.add_joint(
                name=joint.name,
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=axis,
                pos=anchor,
                ref=float(source.qpos0[joint.qposadr[0]]),
                armature=float(joint.armature[0]),
                damping=float(joint.damping[0]),
            )
    return spec.compile()


def effective_inertia(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Inertia [kg m^2] that each joint feels while the others are free, 1 / (M^-1)_ii: [joints]."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    inverse = np.zeros((model.nv, model.nv))
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    return 1 / np.diag(inverse)


def _turned(position: np.ndarray, quaternion: np.ndarray, joint: Any, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a body in its parent after a turn about one of its hinges."""
    turn, turned, before, after = np.zeros(4), np.zeros(4), np.zeros(3), np.zeros(3)
    mujoco.mju_axisAngle2Quat(turn, joint.axis, angle)
    mujoco.mju_mulQuat(turned, quaternion, turn)
    mujoco.mju_rotVecQuat(before, joint.pos, quaternion)
    mujoco.mju_rotVecQuat(after, joint.pos, turned)
    return position + before - after, turned


def _turned_back(anchor: np.ndarray, axis: np.ndarray, joint: Any, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Anchor and axis, in the frame of their body, of a hinge that does not feel a turn about a later one in it."""
    back, lever, turned = np.zeros(4), np.zeros(3), np.zeros(3)
    mujoco.mju_axisAngle2Quat(back, joint.axis, -angle)
    mujoco.mju_rotVecQuat(lever, anchor - joint.pos, back)
    mujoco.mju_rotVecQuat(turned, axis, back)
    return joint.pos + lever, turned
