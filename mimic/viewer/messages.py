"""Which messages of a browser a view accepts: new values of its widgets, the camera, and drags. Needs no viser."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

_CAMERA = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}  # lengths of the vectors in a camera's message
_CAMERA_NUMBERS = ("fov", "near", "far", "image_height", "image_width")
_MIN_NORM = 1e-6  # of a quaternion and of a direction
_MAX_NUMBER = 1e9  # of a camera; float32 holds its square

HAND = "/expert/base/hand"  # of the handle that drags the expert's hand

ValueCheck = Callable[[Any], bool]


def fault(message: Any, check_of: Callable[[str], ValueCheck | None]) -> str | None:
    """The reason to drop a decoded message; "" for a message that the view does not need; None for one to accept.

    Args:
      message: what the browser sent, decoded.
      check_of: whether a value suits the widget with an identifier; None for an unknown widget.
    """
    if not isinstance(message, Mapping) or not isinstance(message.get("type"), str):
        return "no message"
    if message["type"] == "ViewerCameraMessage":
        return None if _is_camera(message) else "bad camera"
    if message["type"] == "TransformControlsUpdateMessage":
        return None if _is_drag(message) else "bad drag"
    return _update_fault(message, check_of) if message["type"] == "GuiUpdateMessage" else ""


def _is_drag(message: Mapping[str, Any]) -> bool:
    """Whether a message moves the handle at the expert's hand."""
    vectors = _is_vector(message.get("wxyz"), 4) and _is_vector(message.get("position"), 3)
    names = {"type", "name", "wxyz", "position"}
    return vectors and message.get("name") == HAND and names <= set(message) <= {*names, "owner"}


def _update_fault(message: Mapping[str, Any], check_of: Callable[[str], ValueCheck | None]) -> str | None:
    uuid, updates = message.get("uuid"), message.get("updates")
    if set(message) != {"type", "uuid", "updates"} or not isinstance(uuid, str):
        return "bad update"
    if not isinstance(updates, Mapping) or set(updates) != {"value"}:
        return "update of more than a value"
    check = check_of(uuid)
    if check is None:
        return ""  # a widget that has been removed
    return None if check(updates["value"]) else f"bad value {updates['value']!r:.40}"


def _is_camera(message: Mapping[str, Any]) -> bool:
    vectors = all(_is_vector(message.get(name), length) for name, length in _CAMERA.items())
    numbers = all(_is_number(message.get(name)) for name in _CAMERA_NUMBERS)
    names = {"type", *_CAMERA, *_CAMERA_NUMBERS}
    directions = vectors and all(math.hypot(*message[name]) > _MIN_NORM for name in ("wxyz", "up_direction"))
    return set(message) == names and numbers and directions and min(message["image_height"], message["image_width"]) > 0


def _is_vector(value: Any, length: int) -> bool:
    return isinstance(value, list | tuple) and len(value) == length and all(map(_is_number, value))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _MAX_NUMBER  # not NaN


def in_range(lower: float, upper: float) -> ValueCheck:
    """A check for finite numbers in a range, both ends included."""
    return lambda value: _is_number(value) and lower <= value <= upper


def one_of(choices: Sequence[str]) -> ValueCheck:
    """A check for one of some names."""
    return lambda value: isinstance(value, str) and value in choices


def is_flag(value: Any) -> bool:
    """Whether a value is true or false."""
    return isinstance(value, bool)
