"""Captured points of a body over time: joints of a skeleton, or markers."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

GAP = 0.2  # s; shorter gaps are bridged, longer ones split a motion
_FAR, _ABRUPT = 0.1, 100.0  # m and m/s^2: of a step between two samples beyond those before and after it
SIDES = ("left", "right")


class ArmPoints(NamedTuple):
    """Names of an arm's points; several names stand for their mean.

    Attributes:
      side: "left" or "right".
      shoulder, elbow, wrist, hand: names; `hand` is empty where no point beyond the wrist is known.
    """

    side: str
    shoulder: tuple[str, ...]
    elbow: tuple[str, ...]
    wrist: tuple[str, ...]
    hand: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class PointMotion:
    """Positions of named points at equal intervals, z up.

    Attributes:
      names: of the points.
      parents: index of each point's parent, -1 where there is none; markers have none.
      positions: [time, points, 3] [m]; NaN where a point was not seen.
      rate: samples per second.
      notes: what the reader assumed or corrected, one line each.
      begin: time of the first sample in the file [s].
      named: the arm whose points the user has named.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    positions: Float[np.ndarray, "time points 3"]
    rate: float
    notes: tuple[str, ...] = ()
    begin: float = 0.0
    named: ArmPoints | None = None

    @property
    def duration(self) -> float:
        """Time from the first sample to the last [s]."""
        return (len(self.positions) - 1) / self.rate

    def index(self, name: str) -> int:
        """Index of a point.

        Raises:
          ValueError: there is no such point.
        """
        if name not in self.names:
            raise ValueError(f"point: expected one of {', '.join(self.names)}, got {name!r}")
        return self.names.index(name)

    def point(self, name: str) -> Float[np.ndarray, "time 3"]:
        """Positions of one point [m]; raises as `index`."""
        return self.positions[:, self.index(name)]

    def select(self, names: Sequence[str]) -> "PointMotion":
        """The motion of some points, without their parents."""
        chosen = self.subset([self.index(name) for name in names])
        return dataclasses.replace(chosen, parents=(-1,) * len(names))

    def subset(self, indices: Sequence[int]) -> "PointMotion":
        """The motion of some points, with their parents as far as they are among them."""
        places = {index: place for place, index in enumerate(indices)}
        names = tuple(self.names[index] for index in indices)
        parents = tuple(places.get(self.parents[index], -1) for index in indices)
        return dataclasses.replace(self, names=names, parents=parents, positions=self.positions[:, list(indices)])

    def cut(self, start: int, stop: int) -> "PointMotion":
        """The samples from `start` up to `stop`."""
        begin = self.begin + start / self.rate
        return dataclasses.replace(self, positions=self.positions[start:stop], begin=begin)


def gaps(motion: PointMotion) -> list[tuple[int, int]]:
    """First sample and number of samples of each interval in which a point was not seen."""
    return intervals(~np.isfinite(motion.positions).all(axis=(1, 2)))


def bridge_gaps(motion: PointMotion) -> tuple[list[PointMotion], int]:
    """The parts of a motion in which all points are known, and the number of bridged gaps.

    Gaps between two known samples of at most 0.2 s are bridged linearly; longer ones split the motion.
    """
    positions = motion.positions.copy()
    count, bridged = len(positions), 0
    for index in range(len(motion.names)):
        track = positions[:, index]
        missing = ~np.isfinite(track).all(axis=1)
        for start, length in intervals(missing):
            if start > 0 and start + length < count and length / motion.rate <= GAP:
                fraction = np.arange(1, length + 1)[:, None] / (length + 1)
                track[start : start + length] = (1 - fraction) * track[start - 1] + fraction * track[start + length]
                bridged += 1
            else:
                track[start : start + length] = np.nan
    whole = dataclasses.replace(motion, positions=positions)
    known = np.isfinite(positions).all(axis=(1, 2))
    return [whole.cut(start, start + length) for start, length in intervals(known)], bridged


def jumps(motion: PointMotion, fastest: float = 20.0) -> Int[np.ndarray, " jumps"]:
    """Samples before which a point moves as no hand can: faster than a speed [m/s], or far and only then.

    The second is what a first frame in another pose, or markers that were exchanged, look like at low rates.
    """
    steps = np.linalg.norm(np.diff(motion.positions, axis=0), axis=2)
    known = np.where(np.isfinite(steps), steps, 0.0)
    beside = np.pad(known, ((1, 1), (0, 0)))
    alone = known - np.maximum(beside[:-2], beside[2:])
    is_jump = (known * motion.rate > fastest) | ((known > _FAR) & (alone * motion.rate**2 > _ABRUPT))
    return np.flatnonzero(is_jump.any(axis=1)) + 1


def segment_lengths(motion: PointMotion) -> Iterator[tuple[str, str, Float[np.ndarray, " time"]]]:
    """Parent, child and distance over time [m] of each pair of connected points."""
    for child, parent in enumerate(motion.parents):
        if parent >= 0:
            length = np.linalg.norm(motion.positions[:, child] - motion.positions[:, parent], axis=1)
            yield motion.names[parent], motion.names[child], length


def median_length(span: Float[np.ndarray, "time 3"]) -> float:
    """Median length of a vector over the times at which it is known; NaN where it never is."""
    length = np.linalg.norm(span, axis=1)
    known = np.isfinite(length)
    return float(np.median(length[known])) if known.any() else math.nan


def intervals(flags: Any) -> list[tuple[int, int]]:
    """First index and length of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(start), int(stop - start)) for start, stop in zip(edges[::2], edges[1::2], strict=True)]
