"""A live session on its page: the arms at each tick, and the numbers as often as a browser can take."""

import math
from collections.abc import Iterator

from mimic.envs.config import EnvConfig
from mimic.viewer.controls import ExpertControls, LiveControls
from mimic.viewer.history import History
from mimic.viewer.live_session import Frame, LiveSession
from mimic.viewer.page import Page

_AT_BOUND = 1e-3  # fraction of the distance within which it counts as the bound


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
