"""The MuJoCo model of a virtual robot: an arm with capsules, joint stops, a floor and a payload."""

import dataclasses

import mujoco
import numpy as np

from mimic.arms.arm import Arm, ArmConfig, arm_spec, build_arm
from mimic.arms.capsules import Capsules, fit_capsules
from mimic.arms.drives import JointFriction, drives_of
from mimic.arms.kinematic_tree import find_chain
from mimic.arms.mujoco_chain import zero_pose
from mimic.control.joint_control import PERIOD
from mimic.control.limits import JointLimits
from mimic.retargeting.costs import changing_pairs

GRAVITY = 9.81  # m/s^2
FLOOR, PAYLOAD = "floor", "payload"
_MIN_PAYLOAD_INERTIA = 1e-6  # kg m^2: the payload is a point mass
# External torque at which a Panda's collision reflex stops it [N m], as in libfranka's examples of joint motions. Other
# robots get the smallest of these, as a fraction of the torque limit.
_COLLISION_TORQUE = {"joint1": 20.0, "joint2": 20.0, "joint3": 18.0, "joint4": 18.0, "joint5": 16.0, "joint6": 14.0,
                     "joint7": 12.0}  # fmt: skip
_COLLISION_FRACTION = 18.0 / 87.0


@dataclasses.dataclass(frozen=True)
class RobotModel:
    """What a virtual robot is built from; it needs no JAX, and can be sent to another process.

    Attributes:
      model: of MuJoCo, with a timestep of 1 ms; the joints are those of the arm, in its order.
      limits: the manufacturer's, for the reflexes.
      friction: of the joints.
      collision_torque: [joints] external torque at which the robot aborts [N m].
      links: bodies of the model that have mass, without the payload.
      tip_direction: of the last link, in the frame of the payload's body.
    """

    model: mujoco.MjModel
    limits: JointLimits
    friction: JointFriction
    collision_torque: np.ndarray
    links: np.ndarray
    tip_direction: np.ndarray


def robot_model(config: ArmConfig) -> RobotModel:
    """The virtual robot of an arm, with the manufacturer's limits whatever the limits of a training are.

    Raises:
      ValueError: what `build_arm` and `fit_capsules` reject.
    """
    arm = build_arm(config, "hardware")
    capsules, drives = fit_capsules(config, "hardware"), drives_of(config, arm)
    spec, rotation, origin = _bodies(arm), *_base_frame(config, arm)
    spec.option.gravity = -GRAVITY * rotation[:, 2]
    _set_stops(spec, arm, drives.limits.position)
    _add_capsules(spec, arm, capsules, rotation, origin)
    tip_direction = _add_payload(spec, arm, rotation, origin)
    model = spec.compile()
    payload = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, PAYLOAD)
    links = np.array([i for i in range(1, model.nbody) if i != payload and model.body_mass[i] > 0])
    collision_torque = _COLLISION_FRACTION * drives.limits.torque
    if config.model == "panda":
        collision_torque = np.array([_COLLISION_TORQUE[name] for name in arm.embodiment.joint_names])
    return RobotModel(model, drives.limits, drives.friction, collision_torque, links, tip_direction)


def _base_frame(config: ArmConfig, arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and origin of the base frame in the world of the arm's model."""
    source = arm_spec(config).compile()
    data = mujoco.MjData(source)
    data.qpos[:] = zero_pose(source)
    mujoco.mj_kinematics(source, data)
    base = find_chain(source, config.base, config.tip).base
    return data.xmat[base].reshape(3, 3).copy(), data.xpos[base].copy()


def _bodies(arm: Arm) -> mujoco.MjSpec:
    """Bodies, inertias and joints of an arm's simulation model, integrated by Euler's method at the robot's period."""
    source, spec = arm.model, mujoco.MjSpec()
    spec.compiler.degree = spec.compiler.autolimits = False
    spec.compiler.fusestatic = False
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER  # implicit in the damping
    spec.option.timestep = PERIOD
    bodies = [spec.worldbody]
    for i in range(1, source.nbody):
        body = bodies[source.body_parentid[i]].add_body(
            name=f"body{i}", pos=source.body_pos[i], quat=source.body_quat[i], gravcomp=1.0
        )
        body.explicitinertial = True
        body.mass, body.inertia = float(source.body_mass[i]), source.body_inertia[i]
        body.ipos, body.iquat = source.body_ipos[i], source.body_iquat[i]
        bodies.append(body)
    for i in range(source.njnt):
        bodies[source.jnt_bodyid[i]].add_joint(
            name=source.joint(i).name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=source.jnt_axis[i],
            pos=source.jnt_pos[i],
            ref=float(source.qpos0[i]),
            armature=float(source.dof_armature[i]),
            damping=[float(source.dof_damping[i]), 0, 0],
        )
    return spec


def _set_stops(spec: mujoco.MjSpec, arm: Arm, position: np.ndarray) -> None:
    for name, bounds in zip(arm.embodiment.joint_names, position, strict=True):
        joint = spec.joint(name)
        joint.limited, joint.range = True, bounds


def _add_capsules(spec: mujoco.MjSpec, arm: Arm, capsules: Capsules, rotation: np.ndarray, origin: np.ndarray) -> None:
    """Adds the capsules as geoms, the floor, and the pairs that may touch: those of the safety layer's clearance."""
    spec.worldbody.add_geom(
        name=FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], pos=origin, quat=_quaternion(rotation),
        contype=0, conaffinity=0,
    )  # fmt: skip
    frames = _zero_frames(arm)
    for i, joint in enumerate(capsules.joint):
        frame_rotation, position = frames[joint + 1]
        start, end = (
            frame_rotation.T @ (rotation @ np.asarray(point) + origin - position)
            for point in (capsules.start[i], capsules.end[i])
        )
        body = spec.worldbody if joint < 0 else spec.body(f"body{arm.model.jnt_bodyid[joint]}")
        is_sphere = np.linalg.norm(end - start) < 1e-6
        shape = mujoco.mjtGeom.mjGEOM_SPHERE if is_sphere else mujoco.mjtGeom.mjGEOM_CAPSULE
        ends = {"pos": start} if is_sphere else {"fromto": np.concatenate([start, end])}
        size = [float(capsules.radius[i]), 0, 0]
        body.add_geom(name=f"capsule{i}", type=shape, size=size, contype=0, conaffinity=0, **ends)
        if not capsules.near_base[i]:
            spec.add_pair(name=f"floor-{i}", geomname1=FLOOR, geomname2=f"capsule{i}")
    changing = changing_pairs(arm.embodiment, capsules)
    for (i, j), changes in zip(capsules.pairs, changing, strict=True):
        if changes:
            spec.add_pair(name=f"pair-{i}-{j}", geomname1=f"capsule{i}", geomname2=f"capsule{j}")


def _zero_frames(arm: Arm) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotation and position of the world, and of the body of each joint in the zero pose."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = zero_pose(arm.model)
    mujoco.mj_kinematics(arm.model, data)
    bodies = [0, *arm.model.jnt_bodyid]
    return [(data.xmat[body].reshape(3, 3).copy(), data.xpos[body].copy()) for body in bodies]


def _add_payload(spec: mujoco.MjSpec, arm: Arm, rotation: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Adds the payload's body at the end of the last link; returns the link's direction in its frame."""
    embodiment = arm.embodiment
    segment = len(embodiment.segment_link) - 1
    joint = embodiment.link_joint[embodiment.segment_link[segment]]
    frame_rotation, position = _zero_frames(arm)[joint + 1]
    tip = frame_rotation.T @ (rotation @ embodiment.segment_end[segment] + origin - position)
    along = embodiment.segment_end[segment] - embodiment.segment_start[segment]
    payload = spec.body(f"body{arm.model.jnt_bodyid[joint]}").add_body(name=PAYLOAD, pos=tip, gravcomp=1.0)
    payload.explicitinertial = True
    payload.mass, payload.inertia = 1.0, [_MIN_PAYLOAD_INERTIA] * 3
    direction = frame_rotation.T @ rotation @ along
    return direction / np.linalg.norm(direction)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    return quaternion
