"""The last seconds of a live view, as a chart."""

import time
from collections import deque

import numpy as np

from mimic.viewer import html
from mimic.viewer.live_session import Frame

RATE = 30.0  # updates a second, as many as a video has
_HISTORY = 15.0  # s of the chart
_PAUSE = 0.5  # s without an update: the arms were at rest, and the chart shall be level there


class History:
    """Distance and bound of the last seconds, for the chart."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._moments: deque[tuple[float, float, float]] = deque()

    def add(self, frame: Frame) -> None:
        """Appends what is shown now."""
        now = time.perf_counter() - self._began
        if self._moments and now - self._moments[-1][0] > _PAUSE:  # nothing changed until just before
            self._moments.append((now - 1 / RATE, *self._moments[-1][1:]))
        self._moments.append((now, frame.distance, frame.bound))
        while self._moments[0][0] < now - _HISTORY:
            self._moments.popleft()

    def chart(self) -> str:
        """Both as curves."""
        times, distance, bound = np.array(self._moments).T
        return html.chart(times, [("distance", distance, html.LEARNER), ("bound", bound, html.BOUND)])
