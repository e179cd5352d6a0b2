"""Captured motions that move the expert of a view: a clip that is played, or points that arrive. Need no browser."""

import bisect
import dataclasses
import re
import sys
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from mimic.motions.mocap.ball_chain import ball_chain_motion
from mimic.motions.mocap.link_motion import LinkMotion
from mimic.motions.mocap.live_points import LiveArm
from mimic.motions.mocap.point_socket import PointListener
from mimic.viewer.timeline import Timeline

SILENCE = 1.0  # s without a sample, after which the sender counts as stopped
PAUSE = 1.0  # s; after a longer one, the next pose may be anywhere


@dataclasses.dataclass(frozen=True, eq=False)
class Clip:
    """Poses of a captured arm over time; between its parts, which gaps separate, it holds the last pose.

    Attributes:
      starts: time of each part [s], as it is played.
      poses: [samples, joints] of each part [rad].
      interval: time between samples [s], as it is played.
    """

    starts: Sequence[float]
    poses: Sequence[Float[np.ndarray, "samples joints"]]
    interval: float

    @property
    def duration(self) -> float:
        """Time of the last sample [s]."""
        return self.starts[-1] + (len(self.poses[-1]) - 1) * self.interval

    def part(self, time: float) -> int:
        """The part at a time [s], or the last one before it."""
        return max(bisect.bisect_right(self.starts, time) - 1, 0)

    def pose(self, time: float) -> Float[np.ndarray, " joints"]:
        """Pose at a time [s], linear between samples [rad]."""
        part = self.part(time)
        poses = self.poses[part]
        sample = float(np.clip((time - self.starts[part]) / self.interval, 0, len(poses) - 1))
        before = min(int(sample), len(poses) - 2)
        return poses[before] + (sample - before) * (poses[before + 1] - poses[before])


def make_clip(
    parts: Sequence[LinkMotion],
    starts: Sequence[float],
    zero: Float[np.ndarray, "links 3 3"],
    *,
    slow_down: float = 1.0,
    cutoff: float,
) -> Clip:
    """The clip of a captured arm.

    Args:
      parts: motions of the arm, in the order of time.
      starts: time of each part in the capture [s].
      zero: see `ball_chain_xml`.
      slow_down: factor on times.
      cutoff: see `motion_states`.
    """
    poses = [ball_chain_motion(part, zero, cutoff=cutoff)[0] for part in parts]
    return Clip([slow_down * (start - starts[0]) for start in starts], poses, slow_down / parts[0].rate)


class ClipPlayer:
    """Plays a clip.

    Attributes:
      clip: the clip.
      timeline: its time.
    """

    def __init__(self, clip: Clip):
        self.clip, self.timeline = clip, Timeline(clip.duration)

    def advance(self, dt: float) -> tuple[np.ndarray | None, bool]:
        """Advances by a time step [s]; returns the pose, None where it has not changed, and whether it jumped."""
        before = self.clip.part(self.timeline.time)
        changed, jumped = self.timeline.advance(dt)
        time = self.timeline.time
        return (self.clip.pose(time), jumped or self.clip.part(time) != before) if changed else (None, False)


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
