"""Embodiments: what the metric knows of an arm. Planar chains, the Panda, and a serial chain of hinges from any MJCF."""

import importlib.resources
import os
from collections.abc import Sequence
from typing import Any, Literal

import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from mimic.chain import Chain, Joint, Link, Locked, lock, read_chain, resolve_locked

Limits = Literal["none", "hardware"]
LIMITS = ("none", "hardware")
READY_POSE = "ready"  # the keyframe that `limits="hardware"` starts from and locks at


@struct.dataclass
class Embodiment:
    """A serial chain of links with hinge joints, in the base frame (paper, eqs. 5-6).

    A frozen pytree: the arrays are leaves, names and structure are static. Arrays are float64; functions cast them to the
    dtype of the pose that they are given.

    Attributes:
      joint_axis: [num_joints, 3] unit axes in the zero pose.
      joint_anchor: [num_joints, 3] a point on each axis in the zero pose [m].
      link_position: [num_links, 3] origins of the link frames in the zero pose [m].
      link_rotation: [num_links, 3, 3] link frames in the zero pose; the x-axis points along the link.
      link_lengths: [num_links] [m].
      joint_range: [num_joints, 2] [rad]; -pi to pi where nothing limits the joint.
      torque_limit: [num_joints] [N m], inf where nothing limits it.
      velocity_limit: [num_joints] rated speed [rad/s], inf where nothing limits it.
      home: [num_joints] the pose that episodes start from [rad].
      name: what the arm is, locked joints included.
      joint_names: base to tip.
      link_names: base to tip; merged links are joined by "+".
      link_joint: index of the last joint that moves each link; -1 for a link that is fixed to the base.
    """

    joint_axis: Float[Any, "joints 3"]
    joint_anchor: Float[Any, "joints 3"]
    link_position: Float[Any, "links 3"]
    link_rotation: Float[Any, "links 3 3"]
    link_lengths: Float[Any, " links"]
    joint_range: Float[Any, "joints 2"]
    torque_limit: Float[Any, " joints"]
    velocity_limit: Float[Any, " joints"]
    home: Float[Any, " joints"]
    name: str = struct.field(pytree_node=False)
    joint_names: tuple[str, ...] = struct.field(pytree_node=False)
    link_names: tuple[str, ...] = struct.field(pytree_node=False)
    link_joint: tuple[int, ...] = struct.field(pytree_node=False)

    @property
    def num_joints(self) -> int:
        return len(self.joint_names)

    @property
    def num_links(self) -> int:
        return len(self.link_names)

    @property
    def chain_length(self) -> Float[Any, ""]:
        """Sum of the link lengths [m]."""
        return self.link_lengths.sum()


def planar_arm(link_lengths: Sequence[float] | Float[Array, " n"], *, frame_at: float = 0.5) -> Embodiment:
    """A planar chain with one joint about z at the start of each link, straight along x in its zero pose (paper, eq. 6).

    Args:
      link_lengths: [n] lengths [m], each above 0.
      frame_at: where a link's frame sits, as a share of its length: 0.5 is the middle (paper), 1 the end.

    Raises:
      ValueError: no link, or a length or `frame_at` out of range.
    """
    lengths = np.asarray(link_lengths, float)
    if lengths.ndim != 1 or lengths.size == 0 or not np.all(np.isfinite(lengths)) or np.any(lengths <= 0):
        raise ValueError(f"link_lengths: expected one or more lengths above 0, got {np.array2string(lengths)}")
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    points = np.stack([ends, 0 * ends, 0 * ends], axis=1)
    joints = tuple(Joint(f"joint{i + 1}", np.array([0.0, 0.0, 1.0]), points[i]) for i in range(lengths.size))
    links = tuple(Link(f"link{i + 1}", points[i], points[i + 1], i) for i in range(lengths.size))
    return from_chain(Chain(joints, links), name=f"planar{lengths.size}", frame_at=frame_at)


def panda_path() -> str:
    """The MJCF file of the Panda."""
    return str(importlib.resources.files("mimic") / "xml" / "panda.xml")


def panda(*, locked: Locked = (), merge_locked: bool = True, limits: Limits = "none") -> Embodiment:
    """The 7-joint Panda, or what is left of it with joints locked.

    Args:
      locked: joint names ("joint3") or numbers (3), locked at 0, or at the ready pose under `limits="hardware"`; a mapping
        {"joint3": angle} gives the angles [rad].
      merge_locked: a locked joint makes one link of the two that it connects (paper); else both stay.
      limits: "none" starts at the zero pose and lets every joint turn within [-pi, pi] (paper; the real arm cannot reach it);
        "hardware" has the maker's joint ranges and starts at the ready pose.

    Raises:
      ValueError: an unknown or duplicate joint, all joints locked, or an unknown `limits`.
    """
    return load_arm(panda_path(), name="panda", locked=locked, merge_locked=merge_locked, limits=limits)[0]


def load_mjcf(
    path_or_model: str | os.PathLike[str] | mujoco.MjModel,
    *,
    locked: Locked = (),
    base: str | None = None,
    tip: str | None = None,
    merge_locked: bool = True,
) -> Embodiment:
    """A serial chain of hinges from any MJCF.

    Links are the capsule sites named link… where the model has them, else the segments from each joint's anchor to the next,
    the last one ending at `tip`. The base frame is that of the body before the first hinge.

    Args:
      path_or_model: an MJCF file, or a compiled model.
      locked: as for `panda`; locked at 0 where no angle is given.
      base: name of the body that the chain starts behind.
      tip: name of the body or site that the chain ends at.
      merge_locked: as for `panda`.

    Raises:
      ValueError: a file that is missing or no MJCF, no hinge, a branch, a loop, or a name that the model lacks.
    """
    return load_arm(path_or_model, locked=locked, base=base, tip=tip, merge_locked=merge_locked, limits="hardware")[0]


def load_arm(
    path_or_model: str | os.PathLike[str] | mujoco.MjModel,
    *,
    name: str | None = None,
    locked: Locked = (),
    base: str | None = None,
    tip: str | None = None,
    merge_locked: bool = True,
    limits: Limits = "hardware",
) -> tuple[Embodiment, mujoco.MjModel, dict[str, float]]:
    """An embodiment, the model that it was read from, and the angles [rad] of its locked joints by name."""
    if limits not in LIMITS:
        raise ValueError(f"limits: expected one of {', '.join(LIMITS)}, got {limits!r}")
    model = path_or_model if isinstance(path_or_model, mujoco.MjModel) else _read_mjcf(path_or_model)
    chain = read_chain(model, base, tip)
    joint_names = tuple(joint.name for joint in chain.joints)
    home = _home(model, joint_names) if limits == "hardware" else dict.fromkeys(joint_names, 0.0)
    angles = resolve_locked(locked, joint_names, home)
    free = [joint_name for joint_name in joint_names if joint_name not in angles]
    if name is None:
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_MODEL, 0) or model.names[: model.names.index(b"\0")].decode()
    embodiment = from_chain(
        lock(chain, angles, merge_locked),
        name=name + "".join(f"-{joint}" for joint in angles),
        home=np.array([home[joint_name] for joint_name in free]),
    )
    if limits == "none":
        embodiment = embodiment.replace(joint_range=np.tile([-np.pi, np.pi], (len(free), 1)))
    return embodiment, model, angles


def from_chain(chain: Chain, *, name: str, home: np.ndarray | None = None, frame_at: float = 0.5) -> Embodiment:
    """The embodiment of a chain; `home` is the zero pose where it is not given."""
    if not 0 <= frame_at <= 1:
        raise ValueError(f"frame_at: expected a share of the link in [0, 1], got {frame_at}")
    joints, links = chain.joints, chain.links
    directions = [(link.end - link.start) / link.length for link in links]
    return Embodiment(
        joint_axis=_tidy([joint.axis for joint in joints]),
        joint_anchor=_tidy([joint.anchor for joint in joints]),
        link_position=_tidy([link.start + frame_at * (link.end - link.start) for link in links]),
        link_rotation=_tidy([_rotation_to(direction) for direction in directions]),
        link_lengths=np.array([link.length for link in links]),
        joint_range=np.array([joint.range for joint in joints]),
        torque_limit=np.array([joint.torque_limit for joint in joints]),
        velocity_limit=np.array([joint.velocity_limit for joint in joints]),
        home=np.zeros(len(joints)) if home is None else home,
        name=name,
        joint_names=tuple(joint.name for joint in joints),
        link_names=tuple(link.name for link in links),
        link_joint=tuple(link.joint for link in links),
    )


def _tidy(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Stacked, with rounding errors around -1, 0 and 1 taken out: what is known to be zero is never computed."""
    array = np.stack(arrays)
    nearest = np.round(array)
    return np.where(np.abs(array - nearest) < 1e-14, nearest, array)


def _snap(values: np.ndarray) -> np.ndarray:
    """Values that quaternions and sines left within 1e-12 of -1, 0 or 1 become it: exact ones cost nothing (`spatial`)."""
    nearest = np.clip(np.round(values), -1, 1)
    return np.where(np.abs(values - nearest) < 1e-12, nearest, values)


def _rotation_to(direction: np.ndarray) -> np.ndarray:
    """The smallest rotation that carries the x-axis onto a unit direction."""
    x_axis = np.array([1.0, 0.0, 0.0])
    cosine = direction[0]
    if cosine < -1 + 1e-12:  # opposite: half a turn about z
        return np.diag([-1.0, -1.0, 1.0])
    axis = np.cross(x_axis, direction)
    skew = np.cross(np.eye(3), axis)
    return np.eye(3) + skew + skew @ skew / (1 + cosine)


def _home(model: mujoco.MjModel, joint_names: tuple[str, ...]) -> dict[str, float]:
    """The pose of the keyframe `ready`, else zero, moved into the joint ranges."""
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, READY_POSE)
    home = {}
    for joint_name in joint_names:
        joint = model.joint(joint_name)
        angle = float(model.key_qpos[key, joint.qposadr[0]]) if key >= 0 else 0.0
        home[joint_name] = float(np.clip(angle, *joint.range)) if model.jnt_limited[joint.id] else angle
    return home


def _read_mjcf(path: str | os.PathLike[str]) -> mujoco.MjModel:
    if not os.path.isfile(path):
        raise ValueError(f"no MJCF file at {os.fspath(path)!r}")
    try:
        return mujoco.MjModel.from_xml_path(os.fspath(path))
    except ValueError as error:
        raise ValueError(f"{os.fspath(path)!r} is not an MJCF model that MuJoCo reads: {' '.join(str(error).split())}") from error
