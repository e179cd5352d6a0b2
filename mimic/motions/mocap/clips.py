"""Cuts a captured motion into demonstrations: slowed down for the robot, in windows, held out by time."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline

from mimic.motions.demonstrations import Demonstrations
from mimic.motions.mocap.ball_chain import AXES, ball_chain_motion
from mimic.motions.mocap.link_motion import CUTOFF, LinkMotion, motion_states

_SPEED_QUANTILE = 0.995  # of the samples; single faster ones do not slow the whole motion down


class Windows(NamedTuple):
    """Demonstrations cut from a motion.

    Attributes:
      demonstrations: the training windows in the order of time, then the held-out ones.
      training, held_out: numbers of windows.
      slow_down: factor by which times are longer than in the capture.
      start: [windows] times in the capture [s].
    """

    demonstrations: Demonstrations
    training: int
    held_out: int
    slow_down: float
    start: Float[np.ndarray, " windows"]


def relative_speeds(motion: LinkMotion, *, cutoff: float = CUTOFF) -> Float[np.ndarray, "time links"]:
    """Angular speed of each link relative to its parent [rad/s]."""
    angular = np.asarray(motion_states(motion, cutoff=cutoff).angular_velocity)
    parents = np.stack([angular[:, parent] if parent >= 0 else 0 * angular[:, 0] for parent in motion.parents], axis=1)
    return np.linalg.norm(angular - parents, axis=2)


def slow_down_for(parts: Sequence[LinkMotion], speed: float, *, cutoff: float = CUTOFF) -> float:
    """Factor on times, at least 1, with which 99.5 % of the samples stay within a relative speed of links [rad/s]."""
    speeds = np.concatenate([relative_speeds(part, cutoff=cutoff).max(axis=1) for part in parts])
    return max(1.0, float(np.quantile(speeds, _SPEED_QUANTILE)) / speed)


# Above 40 lines because of its docstring.
def windows(
    parts: Sequence[LinkMotion],
    zero: Float[np.ndarray, "links 3 3"],
    *,
    starts: Sequence[float],
    dt: float,
    horizon: int,
    slow_down: float = 1.0,
    overlap: float = 0.9,
    held_out: float = 0.2,
    cutoff: float = CUTOFF,
) -> Windows:
    """Cuts motions into windows of one length. The last windows in time are held out; none overlaps a training window.

    Args:
      parts: motions of one body, in the order of time.
      zero: see `ball_chain_xml`.
      starts: time of each part's first sample in the capture [s].
      dt: control step [s].
      horizon: control steps of a window.
      slow_down: factor on times.
      overlap: fraction of a window that it has in common with the next.
      held_out: fraction of the windows that is held out.
      cutoff: see `motion_states`.

    Raises:
      ValueError: no part is as long as two windows, one to train on and one to hold out.
    """
    length = horizon * dt / slow_down  # of a window, in the capture
    step = length * (1 - overlap)
    offsets = np.arange(horizon + 1) * dt / slow_down
    rows, begins = [], []
    for part, start in zip(parts, starts, strict=True):
        duration = (len(part.start) - 1) / part.rate
        if duration < length or len(part.start) < 4:
            continue
        qpos, qvel = ball_chain_motion(part, zero, cutoff=cutoff)
        angles = CubicHermiteSpline(np.arange(len(qpos)) / part.rate, qpos, qvel, axis=0)
        for first in np.arange(0, duration - length + 1e-9, step):
            times = np.minimum(first + offsets, duration)
            rows.append((_principal(angles(times)), angles(times, 1) / slow_down))
            begins.append(start + first)
    training, chosen = _split(np.array(begins), length, held_out)
    if not training:
        longest = max((len(part.start) - 1) / part.rate for part in parts)
        raise ValueError(
            f"source: expected a motion without gaps of {2 * length:.4g} s at least, for a window to train on and one "
            f"to hold out, got {longest:.4g} s; capture.slow_down= and env.horizon= set the length of a window"
        )
    qpos, qvel = (np.stack([rows[i][column] for i in chosen]) for column in (0, 1))
    names = tuple(f"{name}_{axis}" for name in parts[0].names for axis in AXES)
    demonstrations = Demonstrations(qpos, qvel, qpos[:, -1], dt, parts[0].name, names)
    return Windows(demonstrations, training, len(chosen) - training, slow_down, np.array(begins)[chosen])


def _split(begins: np.ndarray, length: float, held_out: float) -> tuple[int, list[int]]:
    """Number of training windows, and the indices of these and of the held-out ones, of which one is enough."""
    for count in range(max(1, round(held_out * len(begins))), 0, -1):
        training = np.flatnonzero(begins + length <= begins[-count:][:1] + 1e-9)
        if len(training):
            return len(training), [*map(int, training), *range(len(begins) - count, len(begins))]
    return 0, []


def slow_down_for_windows(parts: Sequence[LinkMotion], seconds: float) -> float:
    """Factor on times with which two windows [s] fit, one to train on and one to hold out; infinite where none does."""
    durations = sorted(((len(part.start) - 1) / part.rate for part in parts if len(part.start) >= 4), reverse=True)
    longest = max([0.0, *(duration / 2 for duration in durations[:1]), *durations[1:2]])
    return seconds / longest * (1 + 1e-9) if longest else math.inf


def _principal(qpos: np.ndarray) -> np.ndarray:
    """The same motion, shifted by full turns so that it starts in [-pi, pi]."""
    return qpos - 2 * np.pi * np.round(qpos[:1] / (2 * np.pi))


def turned(motion: LinkMotion, yaw: float, pitch: float = 0.0, roll: float = 0.0) -> LinkMotion:
    """The motion in a base frame that is turned about z, then y, then x [rad]: how it is laid on a robot's base."""
    rotation = turn_matrix(yaw, pitch, roll)
    return dataclasses.replace(motion, start=motion.start @ rotation.T, end=motion.end @ rotation.T)


@functools.lru_cache(maxsize=8)
def turn_matrix(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Float[np.ndarray, "3 3"]:
    """Rotation about z, then the new y, then the new x [rad]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
