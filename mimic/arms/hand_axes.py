"""The axes of a hand frame: z along the approach, x in the direction in which the gripper opens; never by meshes.

Files agree on neither: a tool frame may point forward with any of its axes, or with none. So the geometry of the last
joints decides, a frame's own axes are taken where they agree with it, and fingers tell how a gripper opens.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.arms.tool_frames import NO_GRIPPER, Finger, Frame, Gripper, distance

_AGREES = np.cos(np.radians(30))  # an axis within 30 deg of what the geometry says
_PARALLEL = 0.1  # sine of the angle below which two joint axes are parallel
_NO_DIRECTION = 1e-4  # m
_ONE_WAY = 0.6  # ratio of two principal values above which fingers open in several directions
_ACROSS = 0.5  # mean motion of the gripper's joints across the approach, below which the approach is another
_BESIDE = 1e-3  # m; a finger so far from the middle tells its side
_NAMES = "x", "y", "z"
_UNKNOWN_OPENING = "nothing tells how a gripper would open"  # also with a frame that does not point forward with z


class Axes(NamedTuple):
    """Axes of a hand frame in the world, where they are from, and what speaks against them ("" for nothing)."""

    rotation: Float[np.ndarray, "3 3"]
    reason: str
    doubt: str


class Wrist(NamedTuple):
    """The last joint of an arm: the point of its axis that is nearest to the axis before it, and both axes.

    The point does not depend on where files place a joint along its axis. `previous` is None for an arm without a
    joint that is not parallel to the last one; `before` is the joint before that is elsewhere, None for none.
    """

    point: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    previous: Float[np.ndarray, "3"] | None
    before: Float[np.ndarray, "3"] | None


def find_wrist(axes: Sequence[np.ndarray], anchors: Sequence[np.ndarray]) -> Wrist:
    """The wrist of an arm by the axes of its joints, and a point on each, base to tip."""
    last, anchor = axes[-1], anchors[-1]
    elsewhere = [other for other in anchors if distance(other, anchor) > _NO_DIRECTION]
    before = elsewhere[-1] if elsewhere else None
    for axis, other in zip(axes[-2::-1], anchors[-2::-1], strict=True):
        normal = np.cross(axis, last)
        if np.linalg.norm(normal) > _PARALLEL:
            along = np.cross(other - anchor, axis) @ np.cross(last, axis) / (normal @ normal)
            return Wrist(anchor + along * last, last, axis, before)
    return Wrist(anchor, last, None, before)


def approach(point: np.ndarray, wrist: Wrist) -> list[np.ndarray]:
    """The directions in which a tool at a point may approach, the likeliest first; none for a tool at the wrist.

    They are the last joint's axis, towards the tool, for a wrist that rolls, and the direction across it for one that
    pitches: the tool is the farther along the one or the other.
    """
    return _along_and_across(point - wrist.point, wrist.axis)


def _along_and_across(direction: np.ndarray, axis: np.ndarray) -> list[np.ndarray]:
    along = (direction @ axis) * axis
    parts = sorted((along, direction - along), key=lambda part: -float(np.linalg.norm(part)))
    return [part / np.linalg.norm(part) for part in parts if np.linalg.norm(part) > _NO_DIRECTION]


def find_axes(point: np.ndarray, wrist: Wrist, frames: Sequence[Frame] = (), gripper: Gripper = NO_GRIPPER) -> Axes:
    """The axes of the hand frame at a point, given frames whose axes may tell them, the most telling first."""
    z, frame, z_reason, doubt = _approach_axis(point, wrist, frames, gripper)
    x, x_reason = _opening_axis(z, gripper)
    if x is None and frame is not None:
        x, x_reason = _opening_of_frame(z, frame)
        doubt = doubt or _other_opening(x, z, frames) or ("" if _agreeing(frame, z).endswith("z") else _UNKNOWN_OPENING)
    if x is None:
        x, x_reason = _opening_by_joints(z, wrist)
        unknown = _UNKNOWN_OPENING if wrist.previous is not None else ""  # an arm in a plane
        doubt = "; ".join(filter(None, (doubt, unknown)))
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return Axes(np.stack([x, np.cross(z, x), z], axis=1), f"approach by {z_reason}, opening by {x_reason}", doubt)


def _approach_axis(
    point: np.ndarray, wrist: Wrist, frames: Sequence[Frame], gripper: Gripper
) -> tuple[np.ndarray, Frame | None, str, str]:
    """The approach, the frame to take the opening from, where the approach is from, and a doubt."""
    directions = [z for z in approach(point, wrist) if _are_across(gripper, z)] or approach(point, wrist)
    doubt = ""
    if not directions:  # the tool is at the wrist
        directions = [wrist.axis, -wrist.axis]
        if not any(_agreeing(frame, direction) for frame in frames for direction in directions):
            directions = _along_and_across(point - wrist.before, wrist.axis) if wrist.before is not None else directions
            doubt = "the tool is at the last joint, so that its approach may be another"
    for direction in directions if not approach(point, wrist) else directions[:1]:
        if agreeing := [frame for frame in frames if _agreeing(frame, direction)]:
            frame = next((frame for frame in agreeing if _agreeing(frame, direction) == "z"), agreeing[0])
            name = _agreeing(frame, direction)
            return _signed_axes(frame)[name], frame, f"the {name}-axis of {frame}", doubt
    by = "the last joint's axis" if abs(directions[0] @ wrist.axis) > _AGREES else "the direction from the last joint"
    if not frames:
        return directions[0], None, by, doubt
    angle = np.degrees(np.arccos(max(axis @ directions[0] for axis in _signed_axes(frames[0]).values())))
    return (
        directions[0],
        frames[0],
        by,
        doubt or f"{frames[0]} has no axis within {angle:.0f} deg of the approach",
    )


def _agreeing(frame: Frame, direction: np.ndarray) -> str:
    """The name of the axis of a frame that agrees with a direction; "" for none."""
    name, axis = max(_signed_axes(frame).items(), key=lambda entry: entry[1] @ direction)
    return name if axis @ direction > _AGREES else ""


def _are_across(gripper: Gripper, z: np.ndarray) -> bool:
    """Whether the joints of a gripper move across z, as they do where z is the approach."""
    motions = [float(np.linalg.norm(joint.motion(z))) for joint in gripper.joints]
    return not motions or float(np.mean(motions)) > _ACROSS


def _opening_axis(z: np.ndarray, gripper: Gripper) -> tuple[np.ndarray | None, str]:
    """The direction in which most of the gripper's joints move across z, towards its first finger."""
    motions = np.array([joint.motion(z) for joint in gripper.joints]).reshape(-1, 3)
    values, vectors = np.linalg.eigh(motions.T @ motions)
    if not gripper.fingers or values[2] < _ACROSS or values[1] > _ONE_WAY * values[2]:
        return None, ""
    x = vectors[:, 2]
    return x * _side_of(gripper.fingers[0], gripper, x, z), f"its motion towards {gripper.fingers[0].frame}"


def _side_of(finger: Finger, gripper: Gripper, x: np.ndarray, z: np.ndarray) -> float:
    """Whether a finger is on the positive or the negative side of x: where it is, else where it moves."""
    offset = (finger.frame.point - gripper.middle) @ x
    if abs(offset) > _BESIDE:
        return float(np.sign(offset))
    return float(np.sign(finger.joint.motion(z) @ x * finger.joint.sign)) or 1.0


def _opening_of_frame(z: np.ndarray, frame: Frame) -> tuple[np.ndarray, str]:
    """The y-axis of a frame, in which most grippers open; its z-axis where y is the approach."""
    name = "z" if abs(frame.rotation[:, 1] @ z) > _AGREES else "y"
    axis = frame.rotation[:, _NAMES.index(name)]
    return axis, f"the {name}-axis of {frame}"


def _other_opening(x: np.ndarray, z: np.ndarray, frames: Sequence[Frame]) -> str:
    """Names a frame at the same point with an opening axis that is another, if there is one."""
    others = [frame for frame in frames if abs(_opening_of_frame(z, frame)[0] @ x) < _AGREES]
    return f"the opening by {others[0]} is another, as its roll is" if others else ""


def _opening_by_joints(z: np.ndarray, wrist: Wrist) -> tuple[np.ndarray, str]:
    """A direction across the last joints' axes, which is the same in every file of an arm."""
    for axis in (wrist.axis, wrist.previous):
        if axis is not None and np.linalg.norm(np.cross(axis, z)) > _PARALLEL:
            return np.cross(axis, z), "the joints' axes"
    return np.eye(3)[np.argmin(np.abs(z))], "the world's axes"


def _signed_axes(frame: Frame) -> dict[str, np.ndarray]:
    """The axes of a frame and their opposites, by name; z and x first, which tools point forward with."""
    own = {name: frame.rotation[:, _NAMES.index(name)] for name in ("z", "x", "y")}
    return own | {f"-{name}": -axis for name, axis in own.items()}
