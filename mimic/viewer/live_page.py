"""A live session on its page: the arms at each tick, and the numbers as often as a browser can take."""

import math
import time
from collections import deque
from collections.abc import Iterator

import numpy as np

from mimic.envs.config import EnvConfig
from mimic.viewer import html
from mimic.viewer.controls import ExpertControls, LiveControls
from mimic.viewer.live_session import RATE, Frame, LiveSession
from mimic.viewer.page import Page

_AT_BOUND = 1e-3  # fraction of the distance within which it counts as the bound
_HISTORY = 15.0  # s, duration of the chart
_PAUSE = 0.5  # s without an update: the arms were at rest, and the chart is constant there


def show_live(
    page: Page,
    times: Iterator[float],
    live: LiveSession,
    env: EnvConfig,
    expert: ExpertControls,
    numbers_rate: float = math.inf,
) -> None:
    """Moves the arms at each tick, and shows numbers, chart and maps at a rate [1/s]."""
    controls = LiveControls(page.server, live, env, expert)
    history, frame, was_compiling, since_numbers = History(), None, True, 0.0
    is_behind = False  # whether the numbers are older than the arms
    for dt in times:
        expert.advance(dt)
        since_numbers += dt
        try:
            new_frame = live.advance(dt)
        except ValueError as error:
            for client in page.server.get_clients().values():
                client.add_notification("not possible", str(error), color="red", auto_close_seconds=6.0)
            new_frame = None
            controls.update()  # what is not possible has been undone
        compiling = live.is_compiling
        changed = new_frame is not None or (compiling != was_compiling and frame is not None)
        is_behind |= changed
        if changed:
            frame, was_compiling = new_frame or frame, compiling
        if frame is not None and is_behind and since_numbers * numbers_rate >= 1:
            history.add(frame)
            page.show(frame, history.chart(), _note(frame, compiling, live.by_optimiser))
            is_behind, since_numbers = False, 0.0
        elif frame is not None and changed:
            page.move(frame)


def _note(frame: Frame, compiling: bool, by_optimiser: bool) -> str:
    if compiling:
        return "compiling …"
    if frame.hand is not None:
        return frame.hand.note
    excess = frame.distance - frame.bound
    if excess <= _AT_BOUND * max(frame.distance, _AT_BOUND):
        return "at the kinematic bound"
    return f"{excess:.4f} above the bound: " + ("moving, or in a local minimum" if by_optimiser else "pose mapper")


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
