"""Reads BVH files: a skeleton with the angles of its joints over time.

Dialects differ in the spacing of braces, in names with spaces or colons, in the header's number of frames, and in the
position of a joint other than the root: as in Blender, LAFAN1 and assimp, position channels replace its offset.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mimic.base.files import read_text
from mimic.motions.mocap.names import END
from mimic.motions.mocap.tables import frames_note, numbers

_AXES = {"x": 0, "y": 1, "z": 2}
_CHANNEL = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)
_MAX_BYTES = 2**30
_MAX_JOINTS, _MAX_DEPTH = 2000, 200
_MAX_VALUE = 1e7  # of an offset or channel, in degrees or the file's unit


class Joint(NamedTuple):
    """A joint of a skeleton.

    Attributes:
      name: unique in the skeleton.
      parent: index of the parent, -1 for a root.
      offset: position in the parent's frame, in the file's unit.
      channels: quantity ("position" or "rotation") and axis of each value in a frame.
    """

    name: str
    parent: int
    offset: tuple[float, float, float]
    channels: tuple[tuple[str, int], ...]


class Bvh(NamedTuple):
    """Content of a file: joints, values [frames, channels] with angles in degrees, time of a frame [s], and notes."""

    joints: tuple[Joint, ...]
    values: np.ndarray
    frame_time: float
    notes: tuple[str, ...]


def read_bvh(path: Path) -> Bvh:
    """Reads a file.

    Raises:
      ValueError: what is missing or wrong, with its line where it has one.
    """
    text = read_text(path, errors="replace")
    if "\0" in text:
        raise ValueError("expected text in UTF-8, got another encoding, as UTF-16")
    head, *motion = re.split(r"^\s*MOTION\b", text, maxsplit=1, flags=re.MULTILINE | re.IGNORECASE)
    if not motion:
        raise ValueError("it has no MOTION section")
    joints = _hierarchy(head)
    return Bvh(joints, *_motion(motion[0], sum(len(joint.channels) for joint in joints)))


def joint_positions(bvh: Bvh) -> np.ndarray:
    """Positions of the joints [frames, joints, 3], in the file's unit and axes."""
    from scipy.spatial.transform import Rotation  # a tenth of a second to import

    frames = len(bvh.values)
    positions, rotations = [], []
    first = 0
    for joint in bvh.joints:
        local, rotation = np.tile(np.array(joint.offset), (frames, 1)), np.eye(3)
        for (quantity, axis), column in zip(joint.channels, bvh.values.T[first:], strict=False):
            if quantity == "position":
                local[:, axis] = column
            else:
                rotation = rotation @ Rotation.from_euler("xyz"[axis], column[:, None], degrees=True).as_matrix()
        first += len(joint.channels)
        if joint.parent < 0:
            positions.append(local)
            rotations.append(rotation)
        else:
            parent = rotations[joint.parent]
            positions.append(positions[joint.parent] + (parent @ local[:, :, None])[:, :, 0])
            rotations.append(parent @ rotation)
    return np.stack(positions, axis=1)


def rest_positions(bvh: Bvh) -> np.ndarray:
    """Positions of the joints without rotations [joints, 3], a root at 0."""
    positions: list[np.ndarray] = []
    for joint in bvh.joints:
        positions.append(positions[joint.parent] + joint.offset if joint.parent >= 0 else np.zeros(3))
    return np.stack(positions)


def _hierarchy(text: str) -> tuple[Joint, ...]:
    """The joints, parents before children."""
    joints: list[Joint] = []
    open_joints: list[int] = []
    name = None  # of the joint whose brace is to come
    # Braces may stand on the line of a name: each becomes a line of its own.
    for line in text.replace("{", "\n{\n").replace("}", "\n}\n").splitlines():
        keyword, rest = (*line.split(maxsplit=1), "", "")[:2]
        rest = rest.strip()
        match keyword.upper():
            case "" | "HIERARCHY":
                continue
            case "ROOT" | "JOINT" | "END":
                if name is not None:
                    raise ValueError(f"expected an opening brace after joint {name!r:.60}")
                if keyword.upper() == "END":
                    if not open_joints:
                        raise ValueError("it has an end site outside of a joint")
                    name = f"{joints[open_joints[-1]].name}{END}"
                else:
                    name = rest or f"joint_{len(joints)}"
            case "{":
                if name is None:
                    raise ValueError("it has an opening brace without a joint")
                if len(joints) >= _MAX_JOINTS or len(open_joints) >= _MAX_DEPTH:
                    raise ValueError(f"expected at most {_MAX_JOINTS} joints, nested {_MAX_DEPTH} deep")
                taken = {joint.name for joint in joints}
                unique = name if name not in taken else f"{name}_{len(joints)}"
                joints.append(Joint(unique, open_joints[-1] if open_joints else -1, (0.0, 0.0, 0.0), ()))
                open_joints.append(len(joints) - 1)
                name = None
            case "}":
                if not open_joints or name is not None:
                    raise ValueError("it has a closing brace without a joint")
                open_joints.pop()
            case "OFFSET" if open_joints and name is None:
                joints[open_joints[-1]] = joints[open_joints[-1]]._replace(offset=_offset(rest))
            case "CHANNELS" if open_joints and name is None:
                joints[open_joints[-1]] = joints[open_joints[-1]]._replace(channels=_channels(rest))
            case _:
                raise ValueError(
                    f"expected ROOT, JOINT, End Site, OFFSET, CHANNELS or a brace, got {line.strip()!r:.60}"
                )
    if open_joints or name is not None:
        raise ValueError("a closing brace is missing before MOTION")
    if not joints:
        raise ValueError("it has no joint")
    return tuple(joints)


def _offset(text: str) -> tuple[float, float, float]:
    values = _numbers(text.split(), "OFFSET")
    if len(values) != 3:
        raise ValueError(f"OFFSET: expected 3 numbers, got {text!r:.60}")
    return float(values[0]), float(values[1]), float(values[2])


def _channels(text: str) -> tuple[tuple[str, int], ...]:
    count, *names = text.split() or [""]
    matches = [_CHANNEL.fullmatch(name) for name in names]
    if not count.isdigit() or int(count) != len(names) or not all(matches):
        raise ValueError(f"CHANNELS: expected a number and as many of Xposition, ..., Zrotation, got {text!r:.60}")
    return tuple((match[2].lower(), _AXES[match[1].lower()]) for match in matches if match)


def _motion(text: str, channels: int) -> tuple[np.ndarray, float, tuple[str, ...]]:
    """Values, time of a frame [s], and notes."""
    header = re.match(r"\s*Frames\s*:?\s*(\S+)\s+Frame\s+Time\s*:?\s*(\S+)", text, re.IGNORECASE)
    if not header:
        raise ValueError("MOTION: expected 'Frames: N' and 'Frame Time: T'")
    try:
        stated, frame_time = int(float(header[1])), float(header[2])
    except (ValueError, OverflowError) as error:
        raise ValueError(
            f"MOTION: expected numbers of frames and seconds, got {header[1]!r:.30}, {header[2]!r:.30}"
        ) from error
    if not 1e-5 <= frame_time <= 1:
        raise ValueError(f"Frame Time: expected seconds from 1e-5 to 1, got {frame_time:g}")
    if not channels:
        raise ValueError("it has no channels")
    values = _numbers(text[header.end() :].split(), "MOTION")
    frames, rest = divmod(len(values), channels)
    if rest:
        raise ValueError(f"MOTION: expected a multiple of {channels} values, one for each channel, got {len(values):,}")
    if frames < 2:
        raise ValueError(f"MOTION: expected at least 2 frames, got {frames}")
    return values.reshape(frames, channels), frame_time, frames_note(stated, frames)


def _numbers(words: list[str], where: str) -> np.ndarray:
    values = numbers(words, where)
    if not np.all(np.isfinite(values)) or np.any(np.abs(values) > _MAX_VALUE):
        raise ValueError(f"{where}: expected finite numbers of at most {_MAX_VALUE:g}")
    return values
