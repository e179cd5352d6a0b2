"""Where an arm ends: at its tool, between its fingers, or at its last joint; never by meshes.

The one place that chooses it: the last link ends there, joints distal of it are the gripper's, and the hand frame has
its origin there. `mimic.arms.hand_axes` gives its axes.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.hand_axes import Wrist, approach, find_axes, find_wrist
from mimic.arms.names import hand_rank, is_sensor, tool_rank
from mimic.arms.tool_frames import Frame, Gripper, best_frame, body_frame, distance, find_gripper, fixed_frames

# As ints: a MuJoCo enum equals a NumPy integer in one order of the operands and not in the other.
_CAPSULE, _CYLINDER, _MESH = (
    int(kind) for kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_MESH)
)
_AT_JOINT = 1e-6  # m
_NO_NAME = "no name tells where the tool is"
_APART = 0.005  # m; candidates for the origin that are farther apart leave a doubt


class ArmEnd(NamedTuple):
    """The end of an arm in the zero pose, in the world.

    Attributes:
      point: [3] origin of the hand frame [m].
      rotation: [3, 3] hand frame: z along the approach, x in the direction in which the gripper opens.
      reason: where they are from, in words.
      doubt: what speaks against them, in words; empty for nothing.
    """

    point: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    reason: str
    doubt: str = ""


# A frame's name, or a pose [x, y, z, qw, qx, qy, qz] in the frame of the last link; of several chains, one for each.
HandChoice = str | Sequence[float] | Sequence[str | Sequence[float]] | None
_POSE = "x", "y", "z", "qw", "qx", "qy", "qz"


class _Origin(NamedTuple):
    """A point, the frames that may tell the axes, the most telling first, and words."""

    point: Float[np.ndarray, "3"]
    frames: Sequence[Frame]
    reason: str
    doubt: str = ""


def find_end(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    joints: Sequence[int],
    *,
    tip: Frame | None = None,
    marked: Float[np.ndarray, "3"] | None = None,
) -> ArmEnd:
    """The end of an arm, and its hand frame.

    The origin is, in this order: `tip`; a frame that is named as tools are, unless a gripper is mounted there; the mean
    of the tips of the fingers; a frame that is named as hands are; a single finger; `marked`; the farthest other frame
    that is not a sensor's; the farthest end of a simple shape; the joint itself.

    Args:
      model: with the arm.
      data: its kinematics in the zero pose.
      joints: ids of its joints, base to tip.
      tip: the frame that the user names.
      marked: end of the last link [m], where the model marks its links.
    """
    last, anchor = int(model.jnt_bodyid[joints[-1]]), data.xanchor[joints[-1]]
    wrist = find_wrist(data.xaxis[list(joints)], data.xanchor[list(joints)])
    gripper, frames = find_gripper(model, data, last, anchor), list(fixed_frames(model, data, last))
    if tip:
        origin = _Origin(tip.point, [tip], f"{tip}, as tip= says")
    else:
        origin = _named_or_between_fingers(frames, gripper, wrist, anchor)
    if origin is None and marked is not None:
        origin = _Origin(marked, [], "the end of the last link")
    origin = origin or _farthest(model, data, joints[-1], frames)
    axes = find_axes(origin.point, wrist, origin.frames, gripper)
    doubt = "; ".join(filter(None, (origin.doubt, axes.doubt)))
    return ArmEnd(origin.point, axes.rotation, f"{origin.reason}; {axes.reason}", doubt)


def given_ends(
    model: mujoco.MjModel, data: mujoco.MjData, joints: Sequence[int], hand: HandChoice
) -> tuple[ArmEnd, ...]:
    """The hand frames that a user gives, exactly as they are: z is the approach, x the direction of opening.

    Args:
      model: with the arm.
      data: its kinematics in the zero pose.
      joints: id of the last joint of each chain.
      hand: for each chain the name of a site or body that is fixed to the last link, or a pose [x, y, z, qw, qx, qy,
        qz] in the frame of the last link's body [m]; one alone for one chain.

    Raises:
      ValueError: another number of frames, an unknown name, one that is not fixed to the last link, or no pose.
    """
    hands = list(hand) if isinstance(hand, Sequence) and not isinstance(hand, str) else [hand]
    if hands and all(isinstance(number, int | float) for number in hands):
        hands = [hands]
    if len(hands) != len(joints):
        raise ValueError(f"hand: expected {len(joints)} names or poses, one for each chain, got {len(hands)}")
    return tuple(_given_end(model, data, int(model.jnt_bodyid[joint]), value)
                 for joint, value in zip(joints, hands, strict=True))  # fmt: skip


def _given_end(model: mujoco.MjModel, data: mujoco.MjData, last: int, hand: Any) -> ArmEnd:
    if isinstance(hand, str):
        frames = [body_frame(model, data, last), *fixed_frames(model, data, last)]
        frame = next((frame for frame in frames if frame.name == hand), None)
        if frame is None:
            valid = ", ".join(repr(frame.name) for frame in frames if frame.name)
            raise ValueError(f"hand: expected a site or body that is fixed to the last link, {valid}, got {hand!r}")
        return ArmEnd(frame.point, frame.rotation, f"{frame}, as hand= says")
    pose = np.asarray(hand, float) if isinstance(hand, Sequence) and len(hand) == len(_POSE) else np.full(7, np.nan)
    if not np.isfinite(pose).all() or not np.linalg.norm(pose[3:]):
        raise ValueError(f"hand: expected a name or a pose [{', '.join(_POSE)}] in the last link, got {hand!r:.80}")
    rotation, R_world_last = np.empty(9), data.xmat[last].reshape(3, 3)
    mujoco.mju_quat2Mat(rotation, pose[3:] / np.linalg.norm(pose[3:]))
    point = data.xpos[last] + R_world_last @ pose[:3]
    return ArmEnd(point, R_world_last @ rotation.reshape(3, 3), "the pose in the last link that hand= gives")


def _named_or_between_fingers(
    frames: list[Frame], gripper: Gripper, wrist: Wrist, anchor: np.ndarray
) -> _Origin | None:
    """The origin by the names of frames and by the fingers; None where there are neither."""
    fingers, hand = gripper.fingers, best_frame(frames, hand_rank, anchor)
    tools = [frame for frame in frames if tool_rank(frame.name) is not None]
    distal = [frame for frame in tools if len(fingers) < 2 or not _is_mount(frame, gripper, wrist)]
    is_marked = all(finger.has_tip for finger in fingers)
    beyond = f"{fingers[0].frame} is distal of it" if fingers else ""
    if tool := best_frame(distal, tool_rank, anchor):
        at_tool = [tool, *(frame for frame in distal if frame is not tool and _are_at_one_point(frame, tool))]
        doubt = _rivals(distal, tool) or (beyond if _is_mount(tool, gripper, wrist) else "")
        return _Origin(tool.point, at_tool, f"{tool}, named as tools are", doubt)
    if len(fingers) > 1:
        doubt = "" if is_marked else "no frame marks the tips of the fingers, so that it is between their joints"
        told = list(filter(None, (best_frame(tools, tool_rank, anchor) or hand,)))
        return _Origin(gripper.middle, told, f"between {', '.join(str(x.frame) for x in fingers)}", doubt)
    if hand:
        return _Origin(hand.point, [hand], f"{hand}, named as hands are", beyond)
    doubt = "" if is_marked else "no frame marks the tip of the finger, so that it is at its joint"
    return _Origin(fingers[0].frame.point, [], f"{fingers[0].frame}, a finger", doubt) if fingers else None


def _is_mount(frame: Frame, gripper: Gripper, wrist: Wrist) -> bool:
    """Whether a gripper is mounted at a frame: all its fingers begin farther along the approach."""
    directions = approach(gripper.middle, wrist) if gripper.fingers else []
    return bool(directions) and all((finger.base - frame.point) @ directions[0] > _APART for finger in gripper.fingers)


def _rivals(frames: Iterable[Frame], tool: Frame) -> str:
    """Names the farthest of the frames whose names tell as much as that of the tool, if it is elsewhere."""
    others = [frame for frame in frames if tool_rank(frame.name) == tool_rank(tool.name)]
    other = max(others, key=lambda frame: distance(frame.point, tool.point))
    apart = 1e3 * distance(other.point, tool.point)
    return "" if _are_at_one_point(other, tool) else f"{other}, whose name tells as much, is {apart:.0f} mm away"


def _are_at_one_point(frame: Frame, other: Frame) -> bool:
    return distance(frame.point, other.point) <= _APART


def _farthest(model: mujoco.MjModel, data: mujoco.MjData, joint: int, frames: Iterable[Frame]) -> _Origin:
    """The origin of an arm of which no name tells anything."""
    last, anchor = int(model.jnt_bodyid[joint]), data.xanchor[joint]
    others = [frame for frame in frames if not is_sensor(frame.name) and distance(frame.point, anchor) > _AT_JOINT]
    if others:
        farthest = max(others, key=lambda frame: distance(frame.point, anchor))
        return _Origin(farthest.point, [], f"{farthest}, the farthest frame of the last link", _NO_NAME)
    shapes = max(_shape_ends(model, data, last), key=lambda point: distance(point, anchor), default=anchor)
    if distance(shapes, anchor) > _AT_JOINT:
        return _Origin(shapes, [], "the farthest end of the shapes of the last link", _NO_NAME)
    return _Origin(anchor, [], f"joint {model.joint(joint).name!r}, as no frame is fixed to the last link", _NO_NAME)


def _shape_ends(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Iterator[np.ndarray]:
    """Both ends of each capsule and cylinder that is fixed to a body, and the centres of other shapes but meshes."""
    for geom in range(model.ngeom):
        if model.body_weldid[model.geom_bodyid[geom]] == body and model.geom_type[geom] != _MESH:
            is_rod = model.geom_type[geom] in (_CAPSULE, _CYLINDER)
            half = data.geom_xmat[geom].reshape(3, 3)[:, 2] * (model.geom_size[geom, 1] if is_rod else 0)
            yield from (data.geom_xpos[geom] + half, data.geom_xpos[geom] - half)
