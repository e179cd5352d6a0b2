"""Chart of the last seconds of a live view."""

import time
from collections import deque

import numpy as np

from mimic.viewer import html
from mimic.viewer.live_session import Frame

RATE = 30.0  # updates per second, as in a video
_HISTORY = 15.0  # s, duration of the chart
_PAUSE = 0.5  # s without an update: the arms were at rest, and the chart is constant there


class History:
    """Distance and bound of the last seconds."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._samples: deque[tuple[float, float, float]] = deque()

    def add(self, frame: Frame) -> None:
        """Appends the values of the current frame."""
        now = time.perf_counter() - self._started
        if self._samples and now - self._samples[-1][0] > _PAUSE:  # the values were constant until just before
            self._samples.append((now - 1 / RATE, *self._samples[-1][1:]))
        self._samples.append((now, frame.distance, frame.bound))
        while self._samples[0][0] < now - _HISTORY:
            self._samples.popleft()

    def chart(self) -> str:
        """Both as curves over time, as SVG."""
        times, distance, bound = np.array(self._samples).T
        return html.chart(times, [("distance", distance, html.LEARNER), ("bound", bound, html.BOUND)])
