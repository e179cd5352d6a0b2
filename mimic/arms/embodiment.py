"""Embodiments, the kinematics that the metric uses: planar arms, the Panda, chains and trees from any MJCF or URDF."""

import dataclasses
import importlib.resources
import os
from collections.abc import Sequence
from typing import Any, Literal

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax.typing import ArrayLike
from jaxtyping import Float

from mimic.arms.chain import (
    Chain,
    Hand,
    Joint,
    Link,
    Links,
    Locked,
    lock,
    resolve_locked,
    smallest_rotation,
)
from mimic.arms.compile_check import check_magnitudes
from mimic.arms.hand import HandChoice
from mimic.arms.hand_axes import find_axes, find_wrist
from mimic.arms.kinematic_tree import Tip
from mimic.arms.model_files import model_name, read_model
from mimic.arms.mujoco_chain import read_chain
from mimic.arms.start_pose import with_home
from mimic.base.config import check_choice

Limits = Literal["none", "hardware"]
LIMITS = ("none", "hardware")
LONG = 16  # joints; `link_states` of more is a loop, because unrolled code takes long to compile


@struct.dataclass
class Embodiment:
    """Links with revolute joints in one serial chain (paper, eqs. 5-6) or in a tree of chains, in the base frame.

    A frozen pytree: the arrays are leaves, names and structure are static. The constructors return NumPy arrays in
    float64; functions compute in the dtype of the pose. Close over an arm rather than pass it as an argument of
    `jax.jit`: its numbers are then constants while JAX traces, which saves computation (up to 16 joints; see
    `mimic.base.spatial`).

    Attributes:
      joint_axis: [num_joints, 3] unit axes in the zero pose.
      joint_anchor: [num_joints, 3] a point on each axis in the zero pose [m].
      link_position: [num_links, 3] origins of the link frames in the zero pose [m].
      link_rotation: [num_links, 3, 3] link frames in the zero pose; the x-axis points along the link.
      link_lengths: [num_links] lengths [m].
      joint_range: [num_joints, 2] minimum and maximum angle [rad]; -pi to pi for an unlimited joint.
      torque_limit: [num_joints] maximum torque [N m]; inf where the model states none.
      velocity_limit: [num_joints] maximum speed [rad/s]; inf where the model states none.
      home: [num_joints] pose at the start of an episode [rad].
      name: of the arm, followed by its locked joints.
      joint_names: base to tip; in a tree, each joint after its parent.
      link_names: base to tip; merged links are joined by "+".
      link_joint: index of the last joint that moves each link; -1 for a link fixed to the base.
      segment_start, segment_end: [num_segments, 3] segments of the arm's centre line in the zero pose, base to tip [m];
        one for each link, more where locked joints merged links into chords.
      hand_position: [num_hands, 3] origins of the hand frames in the zero pose, the tools' working points [m]; one for
        each chain, none where no hand is known.
      hand_rotation: [num_hands, 3, 3] hand frames in the zero pose: the z-axis along the approach, the x-axis in the
        direction in which the gripper opens.
      segment_link: index of the link of each segment.
      joint_parent: index of each joint's parent, -1 for a joint at the base.
      chains: indices of the links of each chain, base to tip; several chains may begin with the same links.
      chain_names: names of the chains: "arm", or those of the tips of a tree.
      hand_joint: index of the last joint that moves each hand; -1 for none.
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
    segment_start: Float[Any, "segments 3"]
    segment_end: Float[Any, "segments 3"]
    hand_position: Float[Any, "hands 3"]
    hand_rotation: Float[Any, "hands 3 3"]
    name: str = struct.field(pytree_node=False)
    joint_names: tuple[str, ...] = struct.field(pytree_node=False)
    link_names: tuple[str, ...] = struct.field(pytree_node=False)
    link_joint: tuple[int, ...] = struct.field(pytree_node=False)
    segment_link: tuple[int, ...] = struct.field(pytree_node=False)
    joint_parent: tuple[int, ...] = struct.field(pytree_node=False)
    chains: tuple[tuple[int, ...], ...] = struct.field(pytree_node=False)
    chain_names: tuple[str, ...] = struct.field(pytree_node=False)
    hand_joint: tuple[int, ...] = struct.field(pytree_node=False)

    def __repr__(self) -> str:
        return f"Embodiment({self.name}: {self.num_joints} joints, {self.num_links} links)"

    @property
    def num_joints(self) -> int:
        """Number of free joints."""
        return len(self.joint_names)

    @property
    def num_links(self) -> int:
        """Number of links that the metric compares."""
        return len(self.link_names)

    @property
    def chain_length(self) -> Float[Any, ""]:
        """Sum of the link lengths [m]; of a tree, that of the longest chain from the base to a tip."""
        if len(self.chains) == 1:
            return self.link_lengths.sum()
        numpy = np if isinstance(self.link_lengths, np.ndarray) else jnp
        return numpy.max(numpy.stack([self.link_lengths[np.array(chain)].sum() for chain in self.chains]))

    @property
    def is_serial(self) -> bool:
        """Whether each joint is the child of the one before it."""
        return self.joint_parent == tuple(range(-1, self.num_joints - 1))


def planar_arm(link_lengths: Sequence[float] | Float[ArrayLike, " n"], *, frame_at: float = 0.5) -> Embodiment:
    """A planar arm along x in its zero pose, with a joint about z at the start of each link (paper, eq. 6).

    Args:
      link_lengths: [n] lengths [m], each above 0.
      frame_at: position of a link's frame as a fraction of its length: 0.5 is the middle (paper), 1 the end.

    Raises:
      ValueError: no link, or a length or `frame_at` is out of range.
    """
    lengths = np.asarray(link_lengths, float)
    if lengths.ndim != 1 or lengths.size == 0 or not np.all(np.isfinite(lengths)) or np.any(lengths <= 0):
        raise ValueError(f"link_lengths: expected one or more finite lengths above 0 [m], got {lengths.tolist()}")
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    points = np.stack([ends, 0 * ends, 0 * ends], axis=1)
    joints = tuple(Joint(f"joint{i + 1}", np.array([0.0, 0.0, 1.0]), points[i]) for i in range(lengths.size))
    links = tuple(Link(f"link{i + 1}", points[i], points[i + 1], i) for i in range(lengths.size))
    wrist = find_wrist([joint.axis for joint in joints], [joint.anchor for joint in joints])
    hand = Hand(points[-1], find_axes(points[-1], wrist).rotation, lengths.size - 1)
    return from_chain(Chain(joints, links, hands=(hand,)), name=f"planar{lengths.size}", frame_at=frame_at)


def panda_path(name: str = "panda") -> str:
    """Path of the MJCF file of the Panda, or of the two of "panda_pair"."""
    return str(importlib.resources.files("mimic") / "xml" / f"{name}.xml")


def panda(*, locked: Locked = (), links: Links = "kept", limits: Limits = "none") -> Embodiment:
    """The 7-joint Franka Panda, with some joints locked or none.

    Args:
      locked: joint names ("joint3") or numbers (3), locked at 0, or at the ready pose with `limits="hardware"`; a
        mapping {"joint3": angle} sets the angles [rad].
      links: "kept": a locked joint removes no link, so a locked arm has more links than joints; "merged": the two links
        at a locked joint become one, the chord from the start of the first to the end of the second (paper).
      limits: "none": the home pose is the zero pose and all joint ranges are [-pi, pi] (paper; beyond the real arm's);
        "hardware": the manufacturer's joint ranges, and the ready pose as home.

    Raises:
      ValueError: an unknown or duplicate joint, all joints locked, or an unknown `links` or `limits`.
    """
    return load_arm(panda_path(), name="panda", locked=locked, links=links, limits=limits)[0]


def load_mjcf(
    path_or_model: str | os.PathLike[str] | mujoco.MjModel,
    *,
    locked: Locked = (),
    base: str | None = None,
    tip: Tip = None,
    hand: HandChoice = None,
    links: Links = "kept",
) -> Embodiment:
    """Revolute joints of any MJCF or URDF, in a serial chain or a tree, with the ranges and limits of the model.

    Capsule sites named link… are the links (`fromto` gives start and end). In a model without such sites, the links are
    the segments from the origin of the base to the first joint's anchor, and from each anchor to the next; the last one
    ends at `tip`. The base is the parent of the first body with a revolute joint, unless `base` names a body. The world
    has no segment unless `base` names it. The joints of a hand are fixed. For models that branch, see `find_chain` in
    mimic.arms.kinematic_tree.

    Args:
      path_or_model: an MJCF or URDF file, or a compiled model.
      locked: as for `panda`; joints without an angle are locked at 0.
      base: name of the body that carries the chain; the base frame is then its frame.
      tip: name of the body or site at the end of the chain. A list of names gives a tree with a chain to each of them:
        two arms on a torso, a hand with fingers. ["*"] stands for all ends of the model.
      hand: name of a site or body of the last link whose frame is the hand's (z: approach, x: opening), or a pose
        [x, y, z, qw, qx, qy, qz] in the last link's body; for several chains a list. Default: see `find_end`.
      links: as for `panda`; of a tree always "kept". Merged ones have no segment from the base to the first joint,
        because the paper has as many links as joints.

    Raises:
      ValueError: a file that is missing or not a model, no revolute joint, a branch, a loop, a name that the model
        lacks, or what `panda` rejects.
    """
    model = _model(path_or_model)
    chain = read_chain(model, base, tip, hand, base_segment=links == "kept")
    angles = resolve_locked(locked, tuple(joint.name for joint in chain.joints))
    return _locked_embodiment(chain, angles, _name(path_or_model, model), links)


def load_arm(
    path_or_model: str | os.PathLike[str] | mujoco.MjModel,
    *,
    name: str | None = None,
    locked: Locked = (),
    base: str | None = None,
    tip: Tip = None,
    hand: HandChoice = None,
    links: Links = "kept",
    limits: Limits = "hardware",
    home: Any = None,
) -> tuple[Embodiment, mujoco.MjModel, dict[str, float]]:
    """An embodiment, its source model, and the angles [rad] of its locked joints by name.

    As `load_mjcf`, but joints are locked at the home pose: see `limits` of `panda`, and `home` of `ArmConfig`.
    """
    check_choice("limits", limits, LIMITS)
    model = _model(path_or_model)
    chain = read_chain(model, base, tip, hand, base_segment=links == "kept")
    if limits == "none":
        unlimited = (dataclasses.replace(joint, range=(-np.pi, np.pi), home=0.0) for joint in chain.joints)
        chain = dataclasses.replace(chain, joints=tuple(unlimited))
    if home is not None:
        chain = dataclasses.replace(chain, joints=with_home(chain.joints, home, model))
    angles_at_home = {joint.name: joint.home for joint in chain.joints}
    angles = resolve_locked(locked, tuple(angles_at_home), angles_at_home)
    return _locked_embodiment(chain, angles, name or _name(path_or_model, model), links), model, angles


def from_chain(chain: Chain, *, name: str, frame_at: float = 0.5) -> Embodiment:
    """The embodiment of a chain.

    Raises:
      ValueError: `frame_at` is out of range.
    """
    if not 0 <= frame_at <= 1:
        raise ValueError(f"frame_at: expected a fraction of the link in [0, 1], got {frame_at}")
    joints, links = chain.joints, chain.links
    directions = [(link.end - link.start) / link.length for link in links]
    segments = [(start, end, index) for index, link in enumerate(links) for start, end in link.segments]
    return Embodiment(
        joint_axis=snap_to_units(np.stack([joint.axis for joint in joints])),
        joint_anchor=snap_to_units(np.stack([joint.anchor for joint in joints])),
        link_position=snap_to_units(np.stack([link.start + frame_at * (link.end - link.start) for link in links])),
        link_rotation=snap_to_units(np.stack([smallest_rotation(np.eye(3)[0], direction) for direction in directions])),
        link_lengths=np.array([link.length for link in links]),
        joint_range=np.array([joint.range for joint in joints]),
        torque_limit=np.array([joint.torque_limit for joint in joints]),
        velocity_limit=np.array([joint.velocity_limit for joint in joints]),
        home=np.array([joint.home for joint in joints]),
        segment_start=np.stack([start for start, _, _ in segments]),
        segment_end=np.stack([end for _, end, _ in segments]),
        hand_position=snap_to_units(np.array([hand.position for hand in chain.hands]).reshape(-1, 3)),
        hand_rotation=snap_to_units(np.array([hand.rotation for hand in chain.hands]).reshape(-1, 3, 3)),
        name=name,
        joint_names=tuple(joint.name for joint in joints),
        link_names=tuple(link.name for link in links),
        link_joint=tuple(link.joint for link in links),
        segment_link=tuple(index for _, _, index in segments),
        joint_parent=chain.joint_parents,
        chains=tuple(
            tuple(index for index, link in enumerate(links) if number in link.chains)
            for number in range(len(chain.names))
        ),
        chain_names=chain.names,
        hand_joint=tuple(hand.joint for hand in chain.hands),
    )


def segment_arm(arm: Embodiment) -> Embodiment:
    """The arm with one link for each segment of its centre line, and the link frame at the start of the segment."""
    start, end = np.asarray(arm.segment_start), np.asarray(arm.segment_end)
    lengths = np.linalg.norm(end - start, axis=1)
    directions = (end - start) / lengths[:, None]
    return dataclasses.replace(
        arm,
        link_position=snap_to_units(start),
        link_rotation=snap_to_units(np.stack([smallest_rotation(np.eye(3)[0], direction) for direction in directions])),
        link_lengths=lengths,
        link_names=tuple(f"segment{i + 1}" for i in range(len(lengths))),
        link_joint=tuple(arm.link_joint[link] for link in arm.segment_link),
        segment_link=tuple(range(len(lengths))),
        chains=tuple(
            tuple(index for index, link in enumerate(arm.segment_link) if link in chain) for chain in arm.chains
        ),
    )


def without_hands(arm: Embodiment) -> Embodiment:
    """The arm with no known hand, as the paper's metric sees it."""
    return dataclasses.replace(arm, hand_position=np.zeros((0, 3)), hand_rotation=np.zeros((0, 3, 3)), hand_joint=())


def in_chain_lengths(arm: Embodiment) -> Embodiment:
    """The arm with all lengths in units of its chain length."""
    length = arm.chain_length
    return dataclasses.replace(
        arm,
        joint_anchor=arm.joint_anchor / length,
        link_position=arm.link_position / length,
        link_lengths=arm.link_lengths / length,
        segment_start=arm.segment_start / length,
        segment_end=arm.segment_end / length,
        hand_position=arm.hand_position / length,
    )


def _model(path_or_model: str | os.PathLike[str] | mujoco.MjModel) -> mujoco.MjModel:
    if not isinstance(path_or_model, mujoco.MjModel):
        return read_model(path_or_model)
    check_magnitudes(path_or_model)
    return path_or_model


def _name(path_or_model: str | os.PathLike[str] | mujoco.MjModel, model: mujoco.MjModel) -> str:
    return model_name(model, None if isinstance(path_or_model, mujoco.MjModel) else path_or_model)


def _locked_embodiment(chain: Chain, angles: dict[str, float], name: str, links: Links) -> Embodiment:
    return from_chain(lock(chain, angles, links), name="-".join([name, *angles]))


def snap_to_units(values: np.ndarray) -> np.ndarray:
    """Values within 1e-12 of -1, 0 or 1 set to these numbers exactly; others as they are.

    Quaternions and sines leave such rounding errors. Exact zeros and ones cost nothing: see `mimic.base.spatial`.
    """
    nearest = np.clip(np.round(values), -1, 1)
    return np.where(np.abs(values - nearest) < 1e-12, nearest, values)
