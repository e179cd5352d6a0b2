"""Points of a person that arrive, and move the expert of a view. Needs no browser."""

import re
import sys
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from mimic.motions.mocap.live_points import LiveArm
from mimic.motions.mocap.point_socket import PointListener

SILENCE = 1.0  # s without a sample, after which the sender counts as stopped
PAUSE = 1.0  # s; after a longer one, the next pose may be anywhere


class Said:
    """Prints one line for each kind of fault, however often it occurs and whatever its numbers are."""

    def __init__(self) -> None:
        self._kinds: set[str] = set()

    def __call__(self, line: str) -> None:
        """Prints a line, unless one that differs in numbers alone was printed before."""
        kind = re.sub(r"[-+]?\d[\d.e+-]*", "#", line)
        if kind not in self._kinds:
            self._kinds.add(kind)
            print(f"view: {line}", file=sys.stderr, flush=True)


class HandTracker:
    """Drags the hand of an arm as the hand moves whose poses arrive, from where both are after a pause.

    Attributes:
      gripper: opening in the last sample, in the sender's units; None where unknown.
    """

    def __init__(self, listener: PointListener):
        self._listener = listener
        self._then: tuple[np.ndarray, np.ndarray] | None = None  # poses of both hands
        self._paused = PAUSE  # s since the last pose
        self.gripper: float | None = None

    def advance(self, dt: float, arm_hand: Callable[[], Float[np.ndarray, "4 4"]]) -> np.ndarray | None:
        """The goal [4, 4] of the arm's hand [m]; None where no pose has arrived. `arm_hand` gives where it is."""
        self._paused += dt
        sample = self._listener.take()
        if sample is None or sample.hand is None:
            return None
        if self._then is None or self._paused >= PAUSE:
            self._then = sample.hand.pose, arm_hand()
        self._paused, (then, start), self.gripper = 0.0, self._then, sample.hand.gripper
        goal = start.copy()
        goal[:3, 3] += sample.hand.pose[:3, 3] - then[:3, 3]
        goal[:3, :3] = sample.hand.pose[:3, :3] @ then[:3, :3].T @ start[:3, :3]
        return goal

    @property
    def state(self) -> str:
        """Whether poses arrive, as a phrase."""
        return _state(self._listener, "poses of a hand arrive")

    @property
    def summary(self) -> str:
        """Numbers of samples, as a phrase."""
        return f"{self._listener.counts.received} samples, bad lines: {self._listener.counts.bad}"


def _state(listener: PointListener, arrives: str) -> str:
    if listener.silence < SILENCE:
        return arrives
    cause = "the sender is silent" if listener.is_connected else "no sender is connected"
    return f"{cause}, the arms hold their pose"


class PointTracker:
    """Poses of an arm from the newest points of a listener.

    Attributes:
      incomplete: number of samples without all points of the arm; the arm stays where it is.
      unusable: number of samples with all of them that are no pose of the arm, as where its lengths have changed.
    """

    def __init__(self, listener: PointListener, arm: LiveArm):
        self._listener, self._arm, self._say = listener, arm, Said()
        self.incomplete = self.unusable = 0
        self._paused = PAUSE  # s since the last pose

    def advance(self, dt: float) -> tuple[np.ndarray | None, bool]:
        """The pose of the newest sample, None where none has arrived, and whether there was a pause before it."""
        self._paused += dt
        sample = self._listener.take()
        if sample is None:
            return None, False
        if not self._arm.has_all(sample):
            self.incomplete += 1
            return None, False
        try:
            pose = self._arm.pose(sample)
        except ValueError as error:
            self.unusable += 1
            self._say(f"{error}; the arms hold their pose")
            return None, False
        paused, self._paused = self._paused, 0.0
        return pose, paused >= PAUSE

    @property
    def state(self) -> str:
        """Whether points arrive, as a phrase."""
        return _state(self._listener, "points arrive")

    @property
    def summary(self) -> str:
        """Numbers of samples, as a phrase."""
        counts = self._listener.counts
        faults = {
            "bad lines": counts.bad, "without all points of the arm": self.incomplete,
            "that are no pose of it": self.unusable,
            "replaced by newer ones": counts.unused, "rejected connections": counts.rejected,
        }  # fmt: skip
        return ", ".join([f"{counts.received} samples", *(f"{n} {what}" for what, n in faults.items() if n)])
