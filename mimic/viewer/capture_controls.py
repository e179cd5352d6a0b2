"""The controls of a view whose expert is a captured person: the player of a clip, or the state of a sender."""

import sys

import numpy as np
import viser

from mimic.arms.link_match import hand_poses
from mimic.viewer.captured import ClipPlayer, HandTracker, PointTracker
from mimic.viewer.live_session import LiveSession
from mimic.viewer.timeline import TimeControls


class ClipControls:
    """Plays a clip on the expert of a session, with widgets of its time."""

    def __init__(self, session: LiveSession, player: ClipPlayer):
        self._session, self._player = session, player

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""
        self._time_controls = TimeControls(server, self._player.timeline)
        _add_seek_button(server, self._session)

    def advance(self, dt: float) -> None:
        """Moves the expert, and updates the widgets."""
        _show(self._session, *self._player.advance(dt))
        self._time_controls.update(dt)


def _add_seek_button(server: viser.ViserServer, session: LiveSession) -> None:
    best = server.gui.add_button("nearest pose", hint="the best of many initial guesses, at this pose of the person")
    best.on_click(lambda _: session.seek())


def _show(session: LiveSession, pose: np.ndarray | None, jumped: bool) -> None:
    """Moves the expert to a pose, if there is one; where it jumped, the learner seeks the best pose."""
    if pose is not None:
        if jumped:
            session.seek()
        session.show_pose(pose)


class PointControls:
    """Moves the expert of a session by points, or its hand by poses, and says whether they arrive."""

    def __init__(self, session: LiveSession, tracker: PointTracker | HandTracker):
        self._session, self._tracker = session, tracker
        self._state = tracker.state
        self._since_update = 0.0

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""
        self._text = server.gui.add_markdown(self._content())
        _add_seek_button(server, self._session)

    def advance(self, dt: float) -> None:
        """Moves the expert, updates the text, and prints a line where the sender has stopped or started."""
        if isinstance(self._tracker, HandTracker):
            goal = self._tracker.advance(dt, lambda: hand_poses(self._session.expert, self._session.pose)[0])
            if goal is not None:
                self._session.drag_hand(goal, self._tracker.gripper)
        else:
            _show(self._session, *self._tracker.advance(dt))
        if self._tracker.state != self._state:
            self._state = self._tracker.state
            print(f"view: {self._state}", file=sys.stderr, flush=True)
        self._since_update += dt
        if self._since_update > 0.5:
            self._since_update = 0.0
            self._text.content = self._content()

    def _content(self) -> str:
        return f"{self._tracker.state}: {self._tracker.summary}"
