"""An arm as the environments use it: its embodiment, and a lean MuJoCo model that moves exactly its free joints."""

import copy
import dataclasses
import math
import os
from collections.abc import Mapping
from typing import Any, cast

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.chain import Links
from mimic.arms.embodiment import Embodiment, Limits, load_arm, panda_path, planar_arm
from mimic.arms.ignored_elements import ignored_elements
from mimic.arms.model_files import VELOCITY_LIMIT, read_spec

# Planar arms are ours to define: slender rods, whose joints feel about as heavy for their size as the Panda's.
_PLANAR_MASS = 1.0  # kg/m
_PLANAR_ARMATURE = 0.02  # kg m^2
_PLANAR_DAMPING = 0.1  # N m s/rad
_PLANAR_VELOCITY_LIMIT = 2.5  # rad/s
_PLANAR_RADIUS, _PLANAR_COLOUR = 0.03, [0.35, 0.55, 0.85, 1.0]  # what is seen of them [m]

# The largest torque takes a joint from rest to this multiple of its rated speed in one step.
_OFFERED_SPEED_FACTOR = 2.0
UNKNOWN_SPEED = np.pi  # rad/s, taken for the rated speed of joints that have none

_IGNORED = (
    mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_GRAVITY
)


BUILT_IN = "panda", "planar"


@dataclasses.dataclass(frozen=True)
class ArmConfig:
    """Which arm.

    Attributes:
      model: "panda", "planar", or the path of an MJCF or URDF file, which is made absolute.
      locked: joint names or numbers, or a mapping from these to angles [rad].
      link_lengths: of a planar arm [m].
      base: body that the chain starts behind (of a file).
      tip: body or site that the chain ends at (of a file); else see `find_chain`.
      armature: least rotor inertia of each joint, as its motor feels it [kg m^2]; many models state none.
      damping: least damping of each joint [N m s/rad].
    """

    model: str = "panda"
    locked: Any = None  # not a list, which OmegaConf would let no mapping replace
    link_lengths: list[float] = dataclasses.field(default_factory=list)
    base: str | None = None
    tip: str | None = None
    armature: float = 0.0
    damping: float = 0.0

    def __post_init__(self) -> None:
        if not self.model:
            raise ValueError(f"model: expected {', '.join(BUILT_IN)} or the path of an MJCF or URDF file, got nothing")
        for name in ("armature", "damping"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a finite number of at least 0, got {getattr(self, name)}")
        if self.is_file:  # so that a run finds it again from any folder
            object.__setattr__(self, "model", os.path.abspath(os.path.expanduser(self.model)))

    @property
    def is_file(self) -> bool:
        """Whether the arm is read from a file."""
        return self.model not in BUILT_IN


@dataclasses.dataclass(frozen=True)
class Arm:
    """An embodiment and the MuJoCo model that simulates it: one degree of freedom per joint, in the same order.

    Attributes:
      embodiment: its free joints and links.
      model: of the free joints alone.
      locked: angle [rad] of the joints that are held, by name.
      notes: what of its file was set aside, in words.
    """

    embodiment: Embodiment
    model: mujoco.MjModel
    locked: Mapping[str, float]
    notes: tuple[str, ...] = ()


def arm_spec(config: ArmConfig) -> mujoco.MjSpec:
    """The model of an arm as it was written, geoms and all joints included.

    Raises:
      ValueError: no such file, or MuJoCo cannot read it.
    """
    if config.model == "planar":
        return _planar_spec(planar_arm(config.link_lengths))
    path = panda_path() if config.model == "panda" else config.model
    return read_spec(path)


def build_arm(config: ArmConfig, limits: str = "none", links: str = "kept") -> Arm:
    """The arm that a config describes.

    Args:
      config: of the arm.
      limits: see `EnvConfig`.
      links: see `MetricConfig`.

    Raises:
      ValueError: what `panda`, `planar_arm` and `load_mjcf` refuse.
    """
    if config.model == "planar":
        embodiment = planar_arm(config.link_lengths)
        source = _planar_spec(embodiment).compile()
        embodiment, source, angles = load_arm(
            source,
            name=embodiment.name,
            locked=config.locked or (),
            links=cast(Links, links),
            limits=cast(Limits, limits),
        )
        return with_minimum_armature(
            Arm(embodiment, simulation_model(source, embodiment.joint_names, angles), angles), config
        )
    is_panda = config.model == "panda"
    embodiment, source, angles = load_arm(
        panda_path() if is_panda else config.model,
        name="panda" if is_panda else None,
        locked=config.locked or (),
        base=config.base,
        tip=config.tip,
        links=cast(Links, links),
        limits=cast(Limits, limits),
    )
    notes = () if is_panda else ignored_elements(source, config.base, config.tip)
    return with_minimum_armature(
        Arm(embodiment, simulation_model(source, embodiment.joint_names, angles), angles, notes), config
    )


def with_minimum_armature(arm: Arm, config: ArmConfig) -> Arm:
    """The arm whose joints have at least the rotor inertia and the damping of a config."""
    model = copy.copy(arm.model)
    model.dof_armature[:] = np.maximum(model.dof_armature, config.armature)
    model.dof_damping[:] = np.maximum(model.dof_damping, config.damping)
    return dataclasses.replace(arm, model=model)


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


def rated_speed(arm: Embodiment) -> Float[np.ndarray, " joints"]:
    """Largest speed of each joint [rad/s], pi where none is known."""
    return np.where(np.isfinite(arm.velocity_limit), arm.velocity_limit, UNKNOWN_SPEED)


def torque_scale(arm: Arm, action_scale: float, control_dt: float) -> Float[np.ndarray, " joints"]:
    """Largest torque of each joint [N m]: what gets it well beyond its rated speed in one step, at most its limit.

    The full torque of a Panda would take its light joints to tens of rad/s within a step, where nothing can be learned.

    Args:
      arm: the learner.
      action_scale: see `EnvConfig`.
      control_dt: time that a torque is held [s].
    """
    inertia = effective_inertia(arm.model, np.asarray(arm.embodiment.home))
    torque = action_scale * _OFFERED_SPEED_FACTOR * rated_speed(arm.embodiment) * inertia / control_dt
    return np.minimum(torque, arm.embodiment.torque_limit).astype(np.float32)


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


def _planar_spec(arm: Embodiment) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = arm.name
    parent, start = spec.worldbody, 0.0
    for name, joint_name, length in zip(arm.link_names, arm.joint_names, arm.link_lengths, strict=True):
        body = parent.add_body(pos=[start, 0, 0])
        body.add_joint(name=joint_name, axis=[0, 0, 1], armature=_PLANAR_ARMATURE, damping=_PLANAR_DAMPING)
        body.add_site(name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, length, 0, 0], size=[0.01, 0, 0])
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, length, 0, 0], size=[_PLANAR_RADIUS, 0, 0],
            rgba=_PLANAR_COLOUR, contype=0, conaffinity=0,
        )  # fmt: skip
        mass = _PLANAR_MASS * length
        inertia = mass * length**2 / 12
        body.explicitinertial = True
        body.mass, body.ipos, body.inertia = mass, [length / 2, 0, 0], [inertia / 100, inertia, inertia]
        parent, start = body, float(length)
    numeric = spec.add_numeric(name=VELOCITY_LIMIT, size=arm.num_joints)
    numeric.data = [_PLANAR_VELOCITY_LIMIT] * arm.num_joints
    return spec
