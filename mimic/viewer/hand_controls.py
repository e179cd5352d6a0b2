"""The controls of how the learner's hand follows the expert's: by the metric, exactly, or by a clutch."""

import math
from typing import Any

import viser

from mimic.viewer.hand_following import HANDS
from mimic.viewer.live_session import LiveSession
from mimic.viewer.manual_controls import by_user

# Of the learner's base, with steps and maxima.
_BASE = ("x [m]", 0.01, None), ("y [m]", 0.01, None), ("z [m]", 0.01, None), ("yaw [rad]", 0.05, 2 * math.pi)
_SCALES = 0.2, 4.0


class HandControls:
    """Widgets that change how the hand of a session's learner follows."""

    def __init__(self, session: LiveSession):
        self._session = session

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""
        gui, change, hand = server.gui, self._session.follow_hand, self._session.hand
        self._hand = gui.add_dropdown(
            "hand", list(HANDS), initial_value=hand.hand, hint="free: the metric moves the learner"
        )
        self._hand.on_update(by_user(lambda value: change(hand=value)))
        self._clutch = gui.add_checkbox("clutch engaged", hand.is_engaged, hint="open it, move the expert, close it")
        self._clutch.on_update(by_user(lambda value: change(is_engaged=value)))
        scale = gui.add_slider("scale", *_SCALES, 0.05, hand.scale, hint="factor on the hand's translations")
        scale.on_update(by_user(lambda value: change(scale=float(value))))
        mirror = gui.add_checkbox("mirror", hand.mirror, hint="left and right, for a learner that faces you")
        mirror.on_update(by_user(lambda value: change(mirror=value)))
        gui.add_markdown("Base of the learner, in that of the expert:")
        for index, (label, step, most) in enumerate(_BASE):
            number: Any = gui.add_number(label, hand.base[index], min=most and -most, max=most, step=step)
            number.on_update(by_user(lambda value, index=index: self._place(index, float(value))))

    def update(self) -> None:
        """Shows the settings of the session, after one that was not possible."""
        self._hand.value = self._session.hand.hand

    def _place(self, index: int, value: float) -> None:
        base = list(self._session.hand.base)
        base[index] = value
        self._session.follow_hand(base=tuple(base))
