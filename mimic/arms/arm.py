"""An arm for the environments: its embodiment, and a minimal MuJoCo model of exactly its free joints."""

import copy
import dataclasses
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, cast

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.chain import Links
from mimic.arms.compile_check import VELOCITY_LIMIT
from mimic.arms.embodiment import Embodiment, Limits, load_arm, panda_path, planar_arm
from mimic.arms.hand import ArmEnd
from mimic.arms.ignored_elements import ignored_elements
from mimic.arms.kinematic_tree import ALL_ENDS
from mimic.arms.model_files import read_spec
from mimic.arms.mujoco_chain import base_pose, chain_ends
from mimic.arms.named_arms import BUILT_IN, is_arm_name, named_arm
from mimic.arms.simulation_model import effective_inertia, simulation_model
from mimic.base.config import suggestion
from mimic.base.ranges import check_ranges, number

# Planar arms are slender rods; relative to their size, their joints have about the effective inertia of the Panda's.
_PLANAR_MASS = 1.0  # kg/m
_PLANAR_ARMATURE = 0.02  # kg m^2
_PLANAR_DAMPING = 0.1  # N m s/rad
_PLANAR_VELOCITY_LIMIT = 2.5  # rad/s
_PLANAR_RADIUS, _PLANAR_COLOUR = 0.035, [0.35, 0.55, 0.85, 1.0]  # of links, as drawn; chain lengths
_PLANAR_JOINT, _PLANAR_HEIGHT, _PLANAR_DARK = 0.045, 0.045, [0.25, 0.27, 0.3, 1.0]  # of the housings of joints

# The maximum torque accelerates a joint from rest to this multiple of its velocity limit in one step.
SPEED_FACTOR = 2.0
DEFAULT_VELOCITY_LIMIT = np.pi  # rad/s, assumed for joints without a velocity limit


@dataclasses.dataclass(frozen=True)
class ArmConfig:
    """Model of an arm, and changes to it.

    Attributes:
      model: "panda", "planar", "panda_pair" (two Pandas side by side, 0.6 m apart, as one embodiment), the path of an
        MJCF or URDF file, or the name of an arm, see `named_arm`; a path is made absolute, and a name becomes the path.
      locked: joint names or numbers, or a mapping from these to angles [rad].
      link_lengths: lengths of the links of a planar arm [m].
      base: for a file, name of the body that carries the chain.
      tip: for a file, name of the body or site at the end of the chain. Default: see `find_chain`. A list of names
        gives a tree with a chain to each of them, and ["*"] one to each end of the model.
      hand: for a file, the hand's frame: the name of a site or body of the last link, whose z-axis is the approach and
        whose x-axis the direction in which the gripper opens, or a pose [x, y, z, qw, qx, qy, qz] in the last link [m];
        a list for several chains. Default: see `find_end`.
      armature: minimum rotor inertia of each joint, at the joint [kg m^2], or a mapping from joints to it; many models
        state none.
      damping: minimum damping of each joint [N m s/rad], or a mapping from joints to it.
      home: start pose: a list with the angle of each joint from base to tip, locked ones included [rad], a mapping from
        joints to angles, or the name of a keyframe of the model. Default None: by `limits`, see `panda`.
    """

    model: str = "panda"
    locked: Any = None  # not a list, which OmegaConf would let no mapping replace
    # From a micromanipulator's links to a crane's; the kinematics of 100 links take minutes to compile.
    link_lengths: list[float] = number(list, at_least=1e-3, at_most=100.0, entries=(0, 100))
    base: str | None = None
    tip: Any = None
    hand: Any = None
    # Joints of the largest industrial robots have some 1000 kg m^2 and 1000 N m s/rad.
    armature: Any = number(0.0, at_least=0.0, at_most=1e4, by_name=True)
    damping: Any = number(0.0, at_least=0.0, at_most=1e4, by_name=True)
    home: Any = None

    def __post_init__(self) -> None:
        if isinstance(self.model, os.PathLike):
            object.__setattr__(self, "model", os.fspath(self.model))
        if not self.model:
            raise ValueError(f"model: expected {', '.join(BUILT_IN)} or the path of an MJCF or URDF file, got nothing")
        check_ranges(self)
        is_list = isinstance(self.tip, Sequence) and not isinstance(self.tip, str)
        if self.tip is not None and not all(isinstance(name, str) for name in (self.tip if is_list else [self.tip])):
            raise ValueError(f"tip: expected the name of a body or site, or a list of names, got {self.tip!r:.80}")
        for name in ("armature", "damping"):
            if getattr(self, name) is None:
                raise ValueError(f"{name}: expected a number, or a mapping from joints to numbers, got null")
        if self.is_file:  # absolute, so that a run can be loaded from any folder
            path = named_arm(self.model) if is_arm_name(self.model) else os.path.expanduser(self.model)
            object.__setattr__(self, "model", os.path.abspath(path))
        if self.model == "panda_pair" and self.tip is None:
            object.__setattr__(self, "tip", [ALL_ENDS])

    @property
    def is_file(self) -> bool:
        """Whether the arm is read from a file."""
        return self.model not in BUILT_IN


_KEYS = "|".join(field.name for field in dataclasses.fields(ArmConfig))
_KEY_IN_TEXT = re.compile(rf"(?<![\w.])({_KEYS})(?==)|^({_KEYS})(?=:)")


def with_full_keys(text: str, role: str) -> str:
    """A text about an arm with the keys that set it in full, as in learner.tip= for tip=, and for "tip:" in front."""
    return _KEY_IN_TEXT.sub(rf"{role}.\g<0>", text)


@contextmanager
def errors_of(role: str) -> Iterator[None]:
    """Context in which the line of a `ValueError` says of which arm it is, the expert or the learner."""
    try:
        yield
    except ValueError as error:
        line = with_full_keys(str(error), role)
        raise ValueError(line if line.startswith(f"{role}.") else f"{role}: {line}") from error


@dataclasses.dataclass(frozen=True)
class Arm:
    """An embodiment and the MuJoCo model that simulates it: one degree of freedom per joint, in the same order.

    Attributes:
      embodiment: its free joints and links.
      model: MuJoCo model of the free joints only.
      locked: angle [rad] of the locked joints, by name.
      T_world_base: [4, 4] pose of the base frame in the world of the model, whose z-axis is vertical.
      notes: elements of its file that the model ignores, one line each.
      ends: where each of its chains ends, in the world of its file.
    """

    embodiment: Embodiment
    model: mujoco.MjModel
    locked: Mapping[str, float]
    T_world_base: Float[np.ndarray, "4 4"]
    notes: tuple[str, ...] = ()
    ends: tuple[ArmEnd, ...] = ()


class ArmPair(NamedTuple):
    """An expert and the learner that imitates it."""

    expert: Arm
    learner: Arm

    @property
    def embodiments(self) -> tuple[Embodiment, Embodiment]:
        """The embodiments of the expert and of the learner."""
        return self.expert.embodiment, self.learner.embodiment


def arm_spec(config: ArmConfig) -> mujoco.MjSpec:
    """The complete model of an arm, with geoms and all joints.

    Raises:
      ValueError: the file does not exist, or MuJoCo cannot read it.
    """
    if config.model == "planar":
        return _planar_spec(planar_arm(config.link_lengths))
    return read_spec(config.model if config.is_file else panda_path(config.model))


def build_arm(config: ArmConfig, limits: str = "none", links: str = "kept") -> Arm:
    """Builds an arm from its config.

    Args:
      config: of the arm.
      limits: see `EnvConfig`.
      links: see `MetricConfig`.

    Raises:
      ValueError: no config, or what `panda`, `planar_arm` and `load_mjcf` reject.
    """
    if not isinstance(config, ArmConfig):
        raise ValueError(f"config: expected an ArmConfig, as of ArmConfig(model='panda'), got {config!r:.80}")
    is_planar = config.model == "planar"
    path = config.model if config.is_file else panda_path(config.model)
    embodiment, source, angles = load_arm(
        _planar_spec(planar_arm(config.link_lengths)).compile() if is_planar else path,
        name=None if is_planar or config.is_file else config.model,
        locked=config.locked or (),
        base=config.base,
        tip=config.tip,
        hand=config.hand,
        links=cast(Links, links),
        limits=cast(Limits, limits),
        home=config.home,
    )
    notes = () if not config.is_file else ignored_elements(source, config.base, config.tip)
    model = simulation_model(source, embodiment.joint_names, angles)
    ends = chain_ends(source, config.base, config.tip, config.hand)
    arm = Arm(embodiment, model, angles, base_pose(source, config.base, config.tip), notes, ends)
    return with_minimum_armature(arm, config)


def with_minimum_armature(arm: Arm, config: ArmConfig) -> Arm:
    """The arm with at least the rotor inertia and the damping of the config in each joint.

    Raises:
      ValueError: a mapping names a joint that the arm lacks.
    """
    model = copy.copy(arm.model)
    model.dof_armature[:] = np.maximum(model.dof_armature, _by_joint(arm, "armature", config.armature))
    model.dof_damping[:] = np.maximum(model.dof_damping, _by_joint(arm, "damping", config.damping))
    return dataclasses.replace(arm, model=model)


def _by_joint(arm: Arm, key: str, value: Any) -> Float[np.ndarray, " joints"]:
    """A number for each free joint, 0 for those that a mapping does not name; locked joints may be named too."""
    names = arm.embodiment.joint_names
    if not isinstance(value, Mapping):
        return np.full(len(names), value, float)
    unknown = [name for name in value if name not in names and name not in arm.locked]
    if unknown:
        valid = (*names, *arm.locked)
        close = suggestion(str(unknown[0]), valid)
        raise ValueError(f"{key}: unknown joint {unknown[0]!r}; valid are {', '.join(valid)}{close}")
    return np.array([value.get(name, 0.0) for name in names])


def finite_velocity_limit(arm: Embodiment) -> Float[np.ndarray, " joints"]:
    """Maximum speed of each joint [rad/s]; pi where the model states none."""
    return np.where(np.isfinite(arm.velocity_limit), arm.velocity_limit, DEFAULT_VELOCITY_LIMIT)


def torque_scale(arm: Arm, action_scale: float, control_dt: float) -> Float[np.ndarray, " joints"]:
    """Maximum torque of each joint [N m]: exceeds its velocity limit within one step, and keeps its torque limit.

    The full torque of a Panda would accelerate its light joints to tens of rad/s within a step, too fast to learn.

    Args:
      arm: the learner.
      action_scale: see `EnvConfig`.
      control_dt: duration of a torque [s].
    """
    inertia = effective_inertia(arm.model, np.asarray(arm.embodiment.home))
    torque = action_scale * SPEED_FACTOR * finite_velocity_limit(arm.embodiment) * inertia / control_dt
    return np.minimum(torque, arm.embodiment.torque_limit).astype(np.float32)


def _planar_spec(arm: Embodiment) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = arm.name
    parent, start, reach = spec.worldbody, 0.0, float(arm.chain_length)
    for name, joint_name, length in zip(arm.link_names, arm.joint_names, arm.link_lengths, strict=True):
        body = parent.add_body(pos=[start, 0, 0])
        body.add_joint(name=joint_name, axis=[0, 0, 1], armature=_PLANAR_ARMATURE, damping=_PLANAR_DAMPING)
        body.add_site(name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, length, 0, 0], size=[0.01, 0, 0])
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, length, 0, 0], size=[_PLANAR_RADIUS * reach, 0, 0],
            rgba=_PLANAR_COLOUR, contype=0, conaffinity=0,
        )  # fmt: skip
        is_base = parent is spec.worldbody
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[(1.5 if is_base else 1) * _PLANAR_JOINT * reach,
            _PLANAR_HEIGHT * reach, 0], rgba=_PLANAR_DARK, contype=0, conaffinity=0,
        )  # fmt: skip
        mass = _PLANAR_MASS * length
        inertia = mass * length**2 / 12
        body.explicitinertial = True
        body.mass, body.ipos, body.inertia = mass, [length / 2, 0, 0], [inertia / 100, inertia, inertia]
        parent, start = body, float(length)
    numeric = spec.add_numeric(name=VELOCITY_LIMIT, size=arm.num_joints)
    numeric.data = [_PLANAR_VELOCITY_LIMIT] * arm.num_joints
    return spec
