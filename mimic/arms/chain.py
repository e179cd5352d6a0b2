"""Joints and links of an arm as plain numbers, in one chain or a tree of chains, and with some joints locked."""

import dataclasses
import functools
import logging
import math
import operator
from collections.abc import Iterable, Mapping
from typing import Literal

import numpy as np

from mimic.base.config import check_choice

_log = logging.getLogger(__name__)
SHORTEST_LINK = 1e-6  # m; below this a link has no direction
_MAX_LOCKED = 4 * math.pi  # rad; a larger angle is in degrees

Links = Literal["kept", "merged"]
LINKS = ("kept", "merged")
Locked = str | int | Iterable[str | int] | Mapping[str | int, float]


@dataclasses.dataclass(frozen=True)
class Joint:
    """A revolute joint in the zero pose, in the base frame. Units: m, rad, N m, rad/s.

    `home` is its angle in the model's own start pose.
    """

    name: str
    axis: np.ndarray
    anchor: np.ndarray
    range: tuple[float, float] = (-np.pi, np.pi)
    torque_limit: float = np.inf
    velocity_limit: float = np.inf
    home: float = 0.0


Segment = tuple[np.ndarray, np.ndarray]  # start and end [m]


@dataclasses.dataclass(frozen=True)
class Link:
    """A rigid part of the arm in the zero pose, in the base frame.

    Attributes:
      name: of the link; names of merged links are joined by "+".
      start, end: [3] [m].
      joint: index of the last joint that moves it; -1 for a link fixed to the base.
      merged: segments of the arm's centre line that were merged into this link; empty for a link of one segment.
      chains: indices of the chains that it is part of.
    """

    name: str
    start: np.ndarray
    end: np.ndarray
    joint: int
    merged: tuple[Segment, ...] = ()
    chains: tuple[int, ...] = (0,)

    @property
    def length(self) -> float:
        """Distance from start to end [m]."""
        return float(np.linalg.norm(self.end - self.start))

    @property
    def segments(self) -> tuple[Segment, ...]:
        """The part of the centre line that belongs to the link, base to tip."""
        return self.merged or ((self.start, self.end),)


@dataclasses.dataclass(frozen=True)
class Hand:
    """The hand frame at the end of a chain in the zero pose, in the base frame.

    Attributes:
      position: [3] the tool's working point [m].
      rotation: [3, 3] z-axis along the approach, x-axis in the direction in which the gripper opens.
      joint: index of the last joint that moves it; -1 for none.
    """

    position: np.ndarray
    rotation: np.ndarray
    joint: int


@dataclasses.dataclass(frozen=True)
class Chain:
    """Joints and links from the base to the tip, or to the tips of a tree of chains.

    Attributes:
      joints: each after its parent.
      links: in the order of the joints that move them.
      parents: index of each joint's parent, -1 for a joint at the base; None for one chain.
      names: of the chains.
      hands: one at the end of each chain; empty for an arm without a known hand.
    """

    joints: tuple[Joint, ...]
    links: tuple[Link, ...]
    parents: tuple[int, ...] | None = None
    names: tuple[str, ...] = ("arm",)
    hands: tuple[Hand, ...] = ()

    @property
    def joint_parents(self) -> tuple[int, ...]:
        """Index of each joint's parent, -1 for a joint at the base."""
        return tuple(range(-1, len(self.joints) - 1)) if self.parents is None else self.parents


def resolve_locked(
    locked: Locked, joint_names: tuple[str, ...], angles: Mapping[str, float] | None = None
) -> dict[str, float]:
    """Angles [rad] of the locked joints by name.

    Args:
      locked: joint names or numbers (1 is the first joint), or a mapping from these to angles [rad].
      joint_names: the arm's joints in order.
      angles: default angles by name for joints that `locked` lists without one; 0 where absent.

    Raises:
      ValueError: an unknown or duplicate joint, an angle that is not a number of at most 4 pi, or no joint left.
    """
    joints = (locked,) if isinstance(locked, str | int) else locked
    mapping = locked if isinstance(locked, Mapping) else None
    result: dict[str, float] = {}
    for joint in joints:
        name = find_joint(joint, joint_names, "locked")
        if name in result:
            raise ValueError(f"locked: joint {name!r} is named twice; name each joint once")
        result[name] = _angle(name, mapping[joint] if mapping is not None else (angles or {}).get(name, 0.0))
    if len(result) == len(joint_names):
        raise ValueError(f"locked: all {len(joint_names)} joints are locked; at least one must stay free")
    return result


def find_joint(joint: str | int, joint_names: tuple[str, ...], key: str) -> str:
    """The name of a joint, from its name or number.

    Raises:
      ValueError: an unknown joint. The message starts with `key`.
    """
    if isinstance(joint, str) and joint in joint_names:
        return joint
    if not isinstance(joint, str | bool):
        try:
            number = operator.index(joint)
        except TypeError:
            number = 0
        if 1 <= number <= len(joint_names):
            return joint_names[number - 1]
    raise ValueError(f"{key}: unknown joint {joint!r}; valid are {', '.join(joint_names)} or 1 to {len(joint_names)}")


def _angle(name: str, value: float) -> float:
    try:
        angle = float(value)
    except (TypeError, ValueError):
        angle = math.nan
    if not abs(angle) <= _MAX_LOCKED:
        raise ValueError(
            f"locked: expected a finite angle [rad] for joint {name!r}, at most {_MAX_LOCKED:.4g}, got {value!r}"
        )
    return angle


def lock(chain: Chain, locked: Mapping[str, float], links: Links = "kept") -> Chain:
    """The chain with some joints locked at an angle.

    Args:
      chain: the free arm.
      locked: angle [rad] by joint name.
      links: "kept": locking removes a joint and no link; "merged": the links at a locked joint become one, from the
        start of the first to the end of the last (paper: as many links as joints).

    Raises:
      ValueError: an unknown value of `links`, or "merged" for a tree of several chains.
    """
    check_choice("links", links, LINKS)
    if links == "merged" and len(chain.names) > 1:
        raise ValueError(f"links: expected kept for a tree of {len(chain.names)} chains, got merged")
    joints, parents, new_index, placement = _free_joints(chain, locked)
    result: list[Link] = []
    previous_joint = None
    for link in chain.links:
        moved = _moved(link, *placement[link.joint], new_index[link.joint])
        if links == "merged" and result and result[-1].joint == moved.joint and link.joint != previous_joint:
            moved = _merged(result.pop(), moved)
        result.append(moved)
        previous_joint = link.joint
    parents = None if chain.parents is None else parents
    hands = tuple(_moved_hand(hand, *placement[hand.joint], new_index[hand.joint]) for hand in chain.hands)
    return dataclasses.replace(chain, joints=joints, links=drop_zero_length(result), parents=parents, hands=hands)


_Placements = dict[int, tuple[np.ndarray, np.ndarray]]


def _free_joints(
    chain: Chain, locked: Mapping[str, float]
) -> tuple[tuple[Joint, ...], tuple[int, ...], dict[int, int], _Placements]:
    """The free joints and their parents; for each joint of the chain, the last free one and the transform by locks."""
    new_index: dict[int, int] = {-1: -1}
    placement: _Placements = {-1: (np.eye(3), np.zeros(3))}
    joints: list[Joint] = []
    parents: list[int] = []
    for index, (joint, parent) in enumerate(zip(chain.joints, chain.joint_parents, strict=True)):
        rotation, offset = placement[parent]
        axis, anchor = rotation @ joint.axis, rotation @ joint.anchor + offset
        if joint.name in locked:
            joint_rotation = axis_rotation(axis, locked[joint.name])
            rotation, offset = joint_rotation @ rotation, joint_rotation @ (offset - anchor) + anchor
        else:
            joints.append(dataclasses.replace(joint, axis=axis, anchor=anchor))
            parents.append(new_index[parent])
        new_index[index] = new_index[parent] if joint.name in locked else len(joints) - 1
        placement[index] = rotation, offset
    return tuple(joints), tuple(parents), new_index, placement


def _moved(link: Link, rotation: np.ndarray, offset: np.ndarray, joint: int) -> Link:
    start, end = (rotation @ point + offset for point in (link.start, link.end))
    return dataclasses.replace(link, start=start, end=end, joint=joint)


def _moved_hand(hand: Hand, rotation: np.ndarray, offset: np.ndarray, joint: int) -> Hand:
    return Hand(rotation @ hand.position + offset, rotation @ hand.rotation, joint)


def smallest_rotation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation that maps a unit vector onto another, [3, 3]; about any axis where they are opposite."""
    axis, cosine = np.cross(a, b), a @ b
    square_sine = axis @ axis
    if cosine < 0 and square_sine < 1e-24:
        across = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        return 2 * np.outer(across, across) / (across @ across) - np.eye(3)
    # Both are 1 / (1 + cosine), each where it does not suffer from cancellation.
    factor = 1 / (1 + cosine) if cosine > 0 else (1 - cosine) / square_sine
    skew = np.cross(np.eye(3), axis)
    return np.eye(3) + skew + factor * skew @ skew


def _merged(first: Link, second: Link) -> Link:
    """One link from the start of the first to the end of the second."""
    name = f"{first.name}+{second.name}"
    return Link(name, first.start, second.end, second.joint, first.segments + second.segments)


def drop_zero_length(links: Iterable[Link]) -> tuple[Link, ...]:
    """Links without those of length zero, which have no direction; the next link starts at the same point.

    Raises:
      ValueError: no link is left.
    """
    links = tuple(links)
    kept = tuple(link for link in links if link.length > SHORTEST_LINK)
    dropped = [link.name for link in links if link.length <= SHORTEST_LINK]
    if dropped:
        _warn_merged(", ".join(dropped))
    if not kept:
        raise ValueError("the arm has no link of a length above zero")
    return kept


@functools.cache  # warns once, though a run builds an arm several times
def _warn_merged(names: str) -> None:
    _log.warning("links of length zero left out, as they have no direction: %s", names)


def axis_rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """The rotation about a unit axis by an angle [rad] (Rodrigues)."""
    skew = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
