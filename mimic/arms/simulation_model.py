"""The minimal MuJoCo model that simulates an arm: bodies, inertias and the free joints, nothing else."""

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
    """The compiled `simulation_spec`."""
    return simulation_spec(source, joint_names, locked).compile()


def simulation_spec(
    source: mujoco.MjModel, joint_names: tuple[str, ...], locked: Mapping[str, float] | None = None
) -> mujoco.MjSpec:
    """The bodies, inertias and named joints of a model and nothing else.

    No geoms, actuators, constraints, contacts or gravity. Bodies without a remaining joint are fused into their
    parents.

    Args:
      source: any model.
      joint_names: revolute joints to keep.
      locked: angle [rad] of removed joints, by name; other removed joints stay at angle 0.
    """
    locked, spec = locked or {}, _empty_spec()
    bodies = {0: spec.worldbody}
    for body_id in range(1, source.nbody):
        body = source.body(body_id)
        position, quaternion = np.array(body.pos), np.array(body.quat)
        joint_ids = range(source.body_jntadr[body_id], source.body_jntadr[body_id] + source.body_jntnum[body_id])
        kept = []  # revolute joints with their anchors and axes
        for joint in map(source.joint, joint_ids):
            if joint.name in joint_names:
                kept.append((joint, joint.pos, joint.axis))
            elif joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE:  # a removed joint rotates its body permanently
                angle = locked.get(joint.name, 0.0) - float(source.qpos0[joint.qposadr[0]])
                position, quaternion = _rotated_pose(position, quaternion, joint, angle)
                kept = [(other, *_rotated_back(*line, joint, angle)) for other, *line in kept]
        target = bodies[int(source.body_parentid[body_id])].add_body(pos=position, quat=quaternion)
        bodies[body_id] = target
        if source.body_mass[body_id] > 0:
            target.explicitinertial = True
            target.mass, target.ipos, target.iquat = float(body.mass[0]), body.ipos, body.iquat
            target.inertia = body.inertia
        for joint, anchor, axis in kept:
            _add_joint(target, joint, anchor, axis, reference=float(source.qpos0[joint.qposadr[0]]))
    return spec


def _empty_spec() -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.compiler.fusestatic = True
    spec.compiler.autolimits = False
    spec.compiler.degree = False  # the reference angles of the joints are in radians
    spec.option.disableflags = int(_IGNORED)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    return spec


def _add_joint(body: mujoco.MjsBody, joint: Any, anchor: np.ndarray, axis: np.ndarray, reference: float) -> None:
    body.add_joint(
        name=joint.name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=axis,
        pos=anchor,
        ref=reference,
        armature=float(joint.armature[0]),
        damping=float(joint.damping[0]),
    )


def effective_inertia(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Effective inertia [kg m^2] of each joint while the others are free, 1 / (M^-1)_ii: [joints]."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    inverse = np.zeros((model.nv, model.nv))
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    return 1 / np.diag(inverse)


def joint_inertia(model: mujoco.MjModel, qpos: np.ndarray, payload: float = 0.0, tip: Any = None) -> np.ndarray:
    """Inertia [kg m^2] about each joint while the others are locked, the diagonal of the mass matrix: [joints].

    Args:
      model: from `simulation_model`.
      qpos: joint angles [rad].
      payload: point mass [kg] on the last body.
      tip: [3] its position at angles 0, in the world [m].
    """
    data = mujoco.MjData(model)
    last = model.nbody - 1
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    in_body = np.zeros(3) if tip is None else data.xmat[last].reshape(3, 3).T @ (tip - data.xpos[last])
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    inertia, unit = np.zeros((model.nv, model.nv)), np.eye(model.nv)
    for column, row in zip(unit, inertia, strict=True):
        mujoco.mj_mulM(model, data, row, column)
    jacobian = np.zeros((3, model.nv))
    point = data.xpos[last] + data.xmat[last].reshape(3, 3) @ in_body
    mujoco.mj_jac(model, data, jacobian, None, point, last)
    return np.diag(inertia) + payload * np.sum(jacobian**2, axis=0)


def _rotated_pose(
    position: np.ndarray, quaternion: np.ndarray, joint: Any, angle: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a body in its parent after a rotation about one of its joints."""
    rotation, rotated, old_anchor, new_anchor = np.zeros(4), np.zeros(4), np.zeros(3), np.zeros(3)
    mujoco.mju_axisAngle2Quat(rotation, joint.axis, angle)
    mujoco.mju_mulQuat(rotated, quaternion, rotation)
    mujoco.mju_rotVecQuat(old_anchor, joint.pos, quaternion)
    mujoco.mju_rotVecQuat(new_anchor, joint.pos, rotated)
    return position + old_anchor - new_anchor, rotated


def _rotated_back(anchor: np.ndarray, axis: np.ndarray, joint: Any, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Anchor and axis, in the rotated frame of the body, of a joint that precedes a removed one in the same body.

    The removed joint does not move it, so it is rotated back by the removed joint's angle.
    """
    inverse, offset, rotated_axis = np.zeros(4), np.zeros(3), np.zeros(3)
    mujoco.mju_axisAngle2Quat(inverse, joint.axis, -angle)
    mujoco.mju_rotVecQuat(offset, anchor - joint.pos, inverse)
    mujoco.mju_rotVecQuat(rotated_axis, axis, inverse)
    return joint.pos + offset, rotated_axis


def pseudo_inertia(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, frame: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """The sum of m p p^T over a body's points p = (x, y, z, 1) in a frame: second and first moments, and the mass."""
    inertia = model.body_inertia[body]
    result = np.zeros((4, 4))
    axes = frame.T @ data.ximat[body].reshape(3, 3)
    result[:3, :3] = axes @ np.diag(inertia.sum() / 2 - inertia) @ axes.T
    centre = np.append(frame.T @ (data.xipos[body] - origin), 1.0)
    return result + model.body_mass[body] * np.outer(centre, centre)
