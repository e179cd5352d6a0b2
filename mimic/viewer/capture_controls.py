"""The controls of a view whose expert is a captured person: the player of a clip, or the state of a sender."""

import sys
from typing import Any

import viser

from mimic.arms.link_match import hand_poses
from mimic.viewer.captured import ClipPlayer, HandTracker, PointTracker
from mimic.viewer.live_session import LiveSession

_SCRUB_STEP = 0.01  # s
_SCRUB_RATE = 10.0  # updates of the slider per second


class ClipControls:
    """Plays a clip on the expert of a session, with a button and a slider of time."""

    def __init__(self, session: LiveSession, player: ClipPlayer):
        self._session, self._player = session, player
        self._since_update = 0.0

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""
        gui, player = server.gui, self._player
        self._button = gui.add_button("pause")
        self._scrub = gui.add_slider("time [s]", 0.0, round(player.clip.duration, 2), _SCRUB_STEP, 0.0)
        repeats = gui.add_checkbox("repeat", True)
        best = gui.add_button("nearest pose", hint="the best of many initial guesses, at this pose of the person")
        self._button.on_click(lambda _: self._set_playing(not player.is_playing))
        self._scrub.on_update(self._scrubbed)
        repeats.on_update(lambda event: setattr(player, "repeats", event.target.value))
        best.on_click(lambda _: self._session.seek())

    def advance(self, dt: float) -> None:
        """Moves the expert."""
        pose, jumped = self._player.advance(dt)
        if pose is not None:
            if jumped:
                self._session.seek()
            self._session.show_pose(pose)
        self._since_update += dt

    def update(self) -> None:
        """Updates the widgets."""
        if self._since_update > 1 / _SCRUB_RATE and self._player.is_playing:
            self._since_update = 0.0
            self._scrub.value = round(min(self._player.time, self._scrub.max), 2)
        label = "pause" if self._player.is_playing else "play"
        if self._button.label != label:
            self._button.label = label

    def _set_playing(self, playing: bool) -> None:
        if playing and self._player.time >= self._player.clip.duration:
            self._player.go_to(0.0)
        self._player.is_playing = playing

    def _scrubbed(self, event: Any) -> None:
        if event.client is not None:  # the user moved it, not `update`
            self._player.is_playing = False
            self._player.go_to(float(event.target.value))


class PointControls:
    """Moves the expert of a session by points, or its hand by poses, and says whether they arrive."""

    def __init__(self, session: LiveSession, tracker: PointTracker | HandTracker):
        self._session, self._tracker = session, tracker
        self._state = tracker.state
        self._since_update = 0.0

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""
        self._text = server.gui.add_markdown(self._content())
        best = server.gui.add_button("nearest pose", hint="the best of many initial guesses, at this pose")
        best.on_click(lambda _: self._session.seek())

    def advance(self, dt: float) -> None:
        """Moves the expert, and prints a line where the sender has stopped or started."""
        if isinstance(self._tracker, HandTracker):
            goal = self._tracker.advance(dt, lambda: hand_poses(self._session.expert, self._session.pose)[0])
            if goal is not None:
                self._session.drag_hand(goal, self._tracker.gripper)
        else:
            pose, paused = self._tracker.advance(dt)
            if pose is not None:
                if paused:
                    self._session.seek()
                self._session.show_pose(pose)
        if self._tracker.state != self._state:
            self._state = self._tracker.state
            print(f"view: {self._state}", file=sys.stderr, flush=True)
        self._since_update += dt

    def update(self) -> None:
        """Updates the text."""
        if self._since_update > 0.5:
            self._since_update = 0.0
            self._text.content = self._content()

    def _content(self) -> str:
        return f"{self._tracker.state}: {self._tracker.summary}"
