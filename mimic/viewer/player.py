"""Controls of a playback: play, pause, scrub, and the demonstration."""

import math
from typing import Any

import viser

from mimic.evaluation.labels import SPLITS
from mimic.viewer.playback import FRAMES_PER_SECOND, Playback


class Player:
    """Widgets of a playback and its current time.

    Attributes:
      split, demonstration: the demonstration shown.
      time: time since the start of the episode [s].
    """

    def __init__(self, server: viser.ViserServer, playback: Playback, split: str):
        self._playback = playback
        self.split, self.demonstration, self.time = split, 0, 0.0
        self._playing, self._changed = True, True
        gui = server.gui
        self._button = gui.add_button("pause")
        duration = playback.duration(split, 0)
        self._scrub = gui.add_slider("time [s]", 0.0, duration, 1 / FRAMES_PER_SECOND, 0.0)
        self._selected = gui.add_slider("demonstration", 0, playback.count(split) - 1, 1, 0)
        splits = gui.add_dropdown("demonstrations", SPLITS, initial_value=split)
        self._repeat = gui.add_checkbox("repeat", True)
        self._button.on_click(lambda _: self._set_playing(not self._playing))
        self._scrub.on_update(self._scrubbed)
        self._selected.on_update(lambda event: self._select(self.split, int(event.target.value), event))
        splits.on_update(lambda event: self._select(event.target.value, 0, event))

    def advance(self, dt: float) -> bool:
        """Advances by a time step [s]; returns whether the frame has changed."""
        if self._playing:
            end = self._playback.duration(self.split, self.demonstration)
            if self.time >= end and not self._repeat.value:
                self._set_playing(False)
            self.time = 0.0 if self.time >= end else min(self.time + dt, end)
            self._scrub.value = round(self.time, 3)
            self._changed = True
        changed, self._changed = self._changed, False
        return changed

    def _set_playing(self, playing: bool) -> None:
        self._playing = playing
        self._button.label = "pause" if playing else "play"

    def _scrubbed(self, event: Any) -> None:
        if event.client is not None and math.isfinite(event.target.value):  # the user moved it, not `advance`
            self._set_playing(False)
            self.time, self._changed = float(event.target.value), True

    def _select(self, split: str, demonstration: int, event: Any) -> None:
        if event.client is None:
            return
        self._selected.max = self._playback.count(split) - 1
        if split != self.split:
            self._selected.value = demonstration
        self.split, self.demonstration, self.time, self._changed = split, demonstration, 0.0, True
