"""Messages that a view accepts from a browser."""

import math

import pytest

from mimic.viewer.messages import fault, in_range, is_flag, one_of

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0, 0, 0], "position": [2.0, 0, 1], "fov": 0.75, "near": 0.01,
    "far": 1e3, "image_height": 850, "image_width": 1360, "look_at": [0.0, 0, 0], "up_direction": [0.0, 0, 1],
}  # fmt: skip
WIDGETS = {"slider": in_range(-1.0, 1.0), "choice": one_of(["a", "b"]), "box": is_flag}


def update(uuid, value):
    return {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}


@pytest.mark.parametrize(
    "message",
    [CAMERA, update("slider", 1), update("slider", -0.5), update("choice", "b"), update("box", True)],
    ids=repr,
)
def test_what_a_page_sends_is_accepted(message):
    assert fault(message, WIDGETS.get) is None


@pytest.mark.parametrize(
    "message", [{"type": "ShareUrlRequest"}, {"type": "X", "y": 1}, update("removed", 1)], ids=repr
)
def test_what_the_view_does_not_use_is_dropped_silently(message):
    assert fault(message, WIDGETS.get) == ""


@pytest.mark.parametrize(
    "message",
    [
        *(
            update("slider", value)
            for value in (math.nan, math.inf, -math.inf, 1.01, 1e300, "0", None, True, [0.0], 10**400)
        ),
        *(update("choice", value) for value in ("c", 0, None, ["a"], {})),
        *(update("box", value) for value in (1, "true", None)),
        {**update("slider", 0), "updates": {"value": 0, "update_cb": None}},
        {**update("slider", 0), "updates": {"removed": True}},
        {**update("slider", 0), "updates": [0]},
        {**update("slider", 0), "more": 0},
        {**update("slider", 0), "uuid": ["slider"]},
        {**CAMERA, "wxyz": [0.0, 0, 0, 0]},
        {**CAMERA, "position": [math.nan, 0, 0]},
        {**CAMERA, "position": [0.0, 0]},
        {**CAMERA, "fov": "wide"},
        {**CAMERA, "image_width": 0},
        {key: value for key, value in CAMERA.items() if key != "near"},
        {"type": 1},
        {},
        5,
        None,
        [],
    ],
    ids=repr,
)
def test_other_messages_are_faults(message):
    assert fault(message, WIDGETS.get)
