"""Controls of a playback: its time, and the demonstration."""

from typing import Any

import viser

from mimic.evaluation.labels import SPLITS
from mimic.viewer.playback import Playback
from mimic.viewer.timeline import TimeControls, Timeline


class Player:
    """Widgets of a playback.

    Attributes:
      split, demonstration: the demonstration shown.
      timeline: its time.
    """

    def __init__(self, server: viser.ViserServer, playback: Playback, split: str):
        self._playback = playback
        self.split, self.demonstration = split, 0
        self.timeline = Timeline(playback.duration(split, 0))
        self._time_controls, gui = TimeControls(server, self.timeline), server.gui
        self._selected = gui.add_slider("demonstration", 0, playback.count(split) - 1, 1, 0)
        splits = gui.add_dropdown("demonstrations", SPLITS, initial_value=split)
        self._selected.on_update(lambda event: self._select(self.split, int(event.target.value), event))
        splits.on_update(lambda event: self._select(event.target.value, 0, event))

    def advance(self, dt: float) -> bool:
        """Advances by a time step [s]; returns whether the frame has changed."""
        changed, _ = self.timeline.advance(dt)
        self._time_controls.update(dt)
        return changed

    def _select(self, split: str, demonstration: int, event: Any) -> None:
        if event.client is None:
            return
        self._selected.max = self._playback.count(split) - 1
        if split != self.split:
            self._selected.value = demonstration
        self.split, self.demonstration = split, demonstration
        self.timeline.go_to(0.0)
