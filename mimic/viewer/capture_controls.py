"""The controls of a view whose expert points or poses of a hand move: the state of their sender."""

import sys

import viser

from mimic.arms.link_match import hand_poses
from mimic.viewer.captured import HandTracker, PointTracker
from mimic.viewer.live_session import LiveSession


class PointControls:
    """Moves the expert of a session by points, or its hand by poses, and says whether they arrive."""

    def __init__(self, session: LiveSession, tracker: PointTracker | HandTracker):
        self._session, self._tracker = session, tracker
        self._state = tracker.state
        self._since_update = 0.0

    def add_widgets(self, server: viser.ViserServer) -> None:
        """Adds the widgets."""
        self._text = server.gui.add_markdown(self._content())
        best = server.gui.add_button("nearest pose", hint="the best of many initial guesses for this pose")
        best.on_click(lambda _: self._session.seek())

    def advance(self, dt: float) -> None:
        """Moves the expert, updates the text, and prints a line where the sender has stopped or started."""
        if isinstance(self._tracker, HandTracker):
            goal = self._tracker.advance(dt, lambda: hand_poses(self._session.expert, self._session.pose)[0])
            if goal is not None:
                self._session.drag_hand(goal, self._tracker.gripper)
        else:
            pose, jumped = self._tracker.advance(dt)
            if jumped:
                self._session.seek()
            if pose is not None:
                self._session.show_pose(pose)
        if self._tracker.state != self._state:
            self._state = self._tracker.state
            print(f"view: {self._state}", file=sys.stderr, flush=True)
        self._since_update += dt
        if self._since_update > 0.5:
            self._since_update = 0.0
            self._text.content = self._content()

    def _content(self) -> str:
        return f"{self._tracker.state}: {self._tracker.summary}"
