"""Poses of a hand that arrive one sample at a time, as a headset gives them.

A sample is a line of JSON, where gripper and frame may be left out:

    {"time": 12.34, "hand": {"position": [0.1, 1.2, -0.3], "wxyz": [1, 0, 0, 0]}, "gripper": 0.5, "frame": "xr"}

With "xr" the pose is WebXR's or OpenXR's: x right, y up, z back [m], of a space that points along -z, as a grip or a
target ray. Otherwise x is forward, y left, z up, and the hand approaches along its z-axis and opens along x.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

FRAMES = ("xr", "mimic")
_BASE_FROM_XR = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # x right, y up, z back
_XR_FROM_HAND = np.diag([1.0, -1.0, -1.0])  # approach along -z, opening along x
_MAX_VALUE = 1e6  # m
_UNIT = 0.1  # by which the norm of a quaternion may differ from 1


class LiveHand(NamedTuple):
    """A hand.

    Attributes:
      pose: homogeneous matrix in a frame with z up [m].
      gripper: opening, in the sender's units; None where unknown.
    """

    pose: Float[np.ndarray, "4 4"]
    gripper: float | None


def parse_hand(content: dict[str, Any]) -> LiveHand:
    """The hand in the object of a line.

    Raises:
      ValueError: what is wrong with it.
    """
    hand, frame, gripper = content["hand"], content.get("frame", "mimic"), content.get("gripper")
    position, wxyz = ((hand.get(name) if isinstance(hand, dict) else None) or [] for name in ("position", "wxyz"))
    if not _are_numbers(position, 3) or not _are_numbers(wxyz, 4):
        raise ValueError("hand: expected 'position', three numbers [m], and 'wxyz', a quaternion of four")
    if frame not in FRAMES:
        raise ValueError(f"frame: expected one of {', '.join(FRAMES)}, got {frame!r:.60}")
    if gripper is not None and not (is_number(gripper) and math.isfinite(gripper)):
        raise ValueError("gripper: expected a finite number or null")
    norm = math.hypot(*wxyz)
    if not abs(norm - 1) <= _UNIT:
        raise ValueError(f"hand: expected a quaternion of length 1, got {norm:.3g}")
    pose, (w, *xyz) = np.eye(4), np.array(wxyz, float) / norm
    cross = np.cross(np.eye(3), xyz)
    pose[:3, :3], pose[:3, 3] = np.eye(3) + 2 * w * cross + 2 * cross @ cross, position
    if frame == "xr":
        pose[:3, :3] = _BASE_FROM_XR @ pose[:3, :3] @ _XR_FROM_HAND
        pose[:3, 3] = _BASE_FROM_XR @ pose[:3, 3]
    return LiveHand(pose, None if gripper is None else float(gripper))


def _are_numbers(values: Any, count: int) -> bool:
    is_list = isinstance(values, list) and len(values) == count
    return is_list and all(is_number(value) and abs(value) <= _MAX_VALUE for value in values)


def is_number(value: Any) -> bool:
    """Whether a value of JSON is a number that NumPy can hold; true and false are none."""
    return type(value) is float or (type(value) is int and abs(value) < 2**63)
