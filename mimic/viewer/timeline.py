"""The time of a clip or a rollout that is played, and its widgets: play, pause, scrub, repeat."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import viser

_SCRUB_STEP = 0.01  # s
_SCRUB_RATE = 10.0  # updates of the slider per second


class Timeline:
    """The time of what is played. Needs no browser.

    Args:
      duration: of what is played [s].

    Attributes:
      duration: of what is played [s].
      time: since its start [s].
      is_playing: whether time goes on.
      repeats: whether it starts again at its end.
    """

    def __init__(self, duration: float):
        self.duration, self.time, self.is_playing, self.repeats = duration, 0.0, True, True
        self._jumped = self._changed = True

    def advance(self, dt: float) -> tuple[bool, bool]:
        """Advances by a time step [s]; returns whether the time has changed, and whether it jumped."""
        if self.is_playing:
            self._changed = True
            if self.time >= self.duration:
                self.is_playing = self.repeats
                self.go_to(0.0 if self.repeats else self.duration)
            else:
                self.time = min(self.time + dt, self.duration)
        changes, self._changed, self._jumped = (self._changed, self._jumped), False, False
        return changes

    def go_to(self, time: float) -> None:
        """Continues at another time [s]; NaN is dropped."""
        if math.isfinite(time):
            self.time = float(np.clip(time, 0, self.duration))
            self._jumped = self._changed = True


class TimeControls:
    """Widgets of a timeline."""

    def __init__(self, server: "viser.ViserServer", timeline: Timeline):
        self._timeline, self._since_update = timeline, 0.0
        gui = server.gui
        self._button = gui.add_button("pause")
        self._scrub = gui.add_slider("time [s]", 0.0, round(timeline.duration, 2), _SCRUB_STEP, 0.0)
        repeats = gui.add_checkbox("repeat", True)
        self._button.on_click(lambda _: self._set_playing(not timeline.is_playing))
        self._scrub.on_update(self._scrubbed)
        repeats.on_update(lambda event: setattr(timeline, "repeats", event.target.value))

    def update(self, dt: float) -> None:
        """Updates the widgets after a time step [s]."""
        self._since_update += dt
        is_playing = self._timeline.is_playing
        label = "pause" if is_playing else "play"
        has_changed = self._button.label != label
        if has_changed or (is_playing and self._since_update > 1 / _SCRUB_RATE):
            self._since_update = 0.0
            self._scrub.value = round(min(self._timeline.time, self._scrub.max), 2)
        if has_changed:
            self._button.label = label

    def _set_playing(self, playing: bool) -> None:
        if playing and self._timeline.time >= self._timeline.duration:
            self._timeline.go_to(0.0)
        self._timeline.is_playing = playing

    def _scrubbed(self, event: Any) -> None:
        if event.client is not None:  # the user moved it, not `update`
            self._timeline.go_to(float(event.target.value))  # first: `update` then shows this time
            self._timeline.is_playing = False
