"""Repairs recorded motions, or splits them where they cannot be: times, wraps, jumps, gaps, velocities.

Nothing is changed or left out without a note.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from mimic.motions.demonstrations import MAX_VALUE, OVERSHOOT
from mimic.motions.formats.episodes import Motion
from mimic.motions.resampling import angles_and_velocities

FULL_TURN = 2 * np.pi - 1e-6  # rad: a range of a full rotation or more is that of a joint that turns on
_MAX_ANGLE = 4 * np.pi  # rad, of such a joint: beyond, the angles are no rad
_MAX_TURNS = 2  # by which a joint is rotated into its range
_FAR_BEYOND = 0.1  # rad, more than zeros of real arms differ from those of their models
# A jump is what a joint cannot do between two samples: a step of more than 0.15 rad (9 deg) that would need more than
# 100 rad/s^2, several times what arms reach, or 3 rad/s more than before and after.
_JUMP, _MAX_ACCELERATION, _MAX_SPEED = 0.15, 100.0, 3.0
_ASTRAY = 3  # samples between a jump and the one back, which are a fault of the recording
_GAP, _GAP_SAMPLES, _GAP_MOTION = 0.5, 5.0, 0.05  # s, median intervals, rad: no samples for longer, while a joint moved
_LATE, _MOST_LATE = 0.1, 0.1  # s, fraction: samples that arrive out of order are few and late by less
_UNORDERED = 0.2  # fraction of steps back in time, from which rows are in no order
_DOUBLED = 0.01  # of the usual interval: equal samples within it are one that was published twice
_DISAGREEMENT, _SPEED_NOISE = 0.5, 0.05  # of stated and true velocities: relative RMS, and rad/s


class Notes:
    """What was changed in motions: each kind with the motions that it concerns."""

    def __init__(self) -> None:
        self._details: dict[str, list[str]] = {}

    def add(self, kind: str, detail: str) -> None:
        """Notes a change of a kind, with the motion that it concerns."""
        self._details.setdefault(kind, []).append(detail)

    def lines(self) -> list[str]:
        """A line for each kind: how often, and where first."""
        return [
            f"{kind}: {details[0]}" + (f", and {len(details) - 1} more" if len(details) > 1 else "")
            for kind, details in self._details.items()
        ]


def cleaned(
    name: str, motion: Motion, joint_names: Sequence[str], joint_range: Float[np.ndarray, "joints 2"], notes: Notes
) -> dict[str, Motion]:
    """The parts of a motion, by name, between which nothing jumps, with angles [rad] within the range.

    Args:
      name: of the motion.
      motion: angles in rad.
      joint_names: for notes.
      joint_range: [rad].
      notes: get what is changed.

    Raises:
      ValueError: less than two samples, angles that no arm has, or a part whose angles are beyond the range.
    """
    motion = _finite(name, motion, notes)
    parts = []
    for forward in _forward_parts(name, motion, notes):
        unwrapped = np.unwrap(forward.qpos, axis=0)
        if wraps := int(np.sum(np.any(np.abs(np.diff(unwrapped - forward.qpos, axis=0)) > np.pi, axis=1))):
            notes.add("full turns undone", f"{wraps} in {name}")
        parts += _without_jumps(name, forward._replace(qpos=unwrapped), joint_names, notes)
    parts = [part for part in parts if len(part.time) > 1]
    if not parts:
        raise ValueError(f"source: {name} needs two or more samples at times that increase")
    names = [name] if len(parts) == 1 else [f"{name}, part {number}" for number in range(1, len(parts) + 1)]
    return {
        label: _checked_velocities(label, _in_range(label, part, joint_names, joint_range, notes), notes)
        for label, part in zip(names, parts, strict=True)
    }


def _finite(name: str, motion: Motion, notes: Notes) -> Motion:
    """The samples whose time and angles are numbers; without velocities where some are none."""
    kept = np.isfinite(motion.time) & np.all(np.isfinite(motion.qpos), axis=1)
    if not kept.any():
        raise ValueError(f"source: {name} has no sample whose time and angles are numbers")
    if not kept.all():
        notes.add("samples without numbers left out", f"{np.sum(~kept)} of {len(kept)} in {name}")
        motion = motion.take(kept)
    if (largest := float(np.abs(motion.qpos).max())) > MAX_VALUE:
        raise ValueError(f"source: {name} has angles up to {largest:.3g} rad, which no arm has")
    if motion.qvel is not None and not np.all(np.isfinite(motion.qvel)):
        notes.add("velocities computed, since the source's are no numbers", name)
        motion = motion._replace(qvel=None)
    return motion


def _forward_parts(name: str, motion: Motion, notes: Notes) -> list[Motion]:
    """The parts between steps back in time, each without repeated samples.

    Raises:
      ValueError: rows in no order, of several motions.
    """
    interval = np.diff(motion.time)
    if np.sum(interval < 0) > max(_UNORDERED * len(interval), 1):
        if len(np.unique(motion.time)) < len(motion.time):
            raise ValueError(
                f"source: {name} has rows in no order, at times that repeat; expected one motion after another"
            )
        notes.add("samples put in the order of their times", f"all {len(motion.time)} in {name}")
        motion = motion.take(np.argsort(motion.time))
        interval = np.diff(motion.time)
    late = (interval < 0) & (interval > -_LATE)
    if 0 < np.sum(late) < _MOST_LATE * len(interval):
        notes.add("samples put in the order of their times", f"{np.sum(late)} of {len(interval)} in {name}")
        motion = motion.take(_in_order(motion.time))
    back = np.flatnonzero(np.diff(motion.time) < 0)
    if len(back):
        notes.add("split where time steps back", f"{name}, {len(back)} times, first after {motion.time[back[0]]:g} s")
    parts = []
    for rows in np.split(np.arange(len(motion.time)), back + 1):
        part = motion.take(rows)
        interval, is_same = np.diff(part.time), np.all(np.diff(part.qpos, axis=0) == 0, axis=1)
        usual = float(np.percentile(interval, 75)) if len(interval) else 0.0  # of each other one where all are doubled
        new = np.concatenate([[True], (interval > 0) & ~(is_same & (interval < _DOUBLED * usual))])
        if not new.all():
            notes.add("repeated samples left out", f"{np.sum(~new)} of {len(new)} in {name}")
        parts.append(part.take(new))
    return parts


def _in_order(time: np.ndarray) -> np.ndarray:
    """Indices that sort samples between steps back in time of more than `_LATE`."""
    restarts = np.concatenate([[0], np.cumsum(np.diff(time) <= -_LATE)])
    return np.lexsort((time, restarts))


def _without_jumps(name: str, motion: Motion, joint_names: Sequence[str], notes: Notes) -> Iterator[Motion]:
    """The parts between jumps of a joint, and between gaps in which a joint moved, without samples that jump away."""
    if (kept := _not_astray(motion)) is not None:
        notes.add("samples that jump away and back left out", f"{np.sum(~kept)} of {len(kept)} in {name}")
        motion = motion.take(kept)
    interval, change, jumps = np.diff(motion.time), np.diff(motion.qpos, axis=0), _jumps(motion)
    is_long = interval > max(_GAP, _GAP_SAMPLES * float(np.median(interval))) if len(interval) else np.zeros(0, bool)
    gaps = is_long & np.any(np.abs(change) > _GAP_MOTION, axis=1)
    for sample, joint in np.argwhere(jumps)[:1]:
        notes.add(
            "split where a joint jumps",
            f"{name}, {np.sum(jumps.any(axis=1))} times, first {joint_names[joint]} by {change[sample, joint]:.3g} rad "
            f"within {interval[sample]:.3g} s at {motion.time[sample]:g} s",
        )
    for sample in np.flatnonzero(gaps)[:1]:
        notes.add(
            "split at gaps",
            f"{name}, {np.sum(gaps)} times, first {interval[sample]:.3g} s from {motion.time[sample]:g} s",
        )
    yield from map(motion.take, np.split(np.arange(len(motion.time)), np.flatnonzero(jumps.any(axis=1) | gaps) + 1))


def _jumps(motion: Motion) -> Bool[np.ndarray, "intervals joints"]:
    """Whether a joint jumps between two samples."""
    interval, change = np.diff(motion.time)[:, None], np.diff(motion.qpos, axis=0)
    if len(interval) < 2:
        return np.zeros(change.shape, bool)
    velocity = change / interval
    before, after = np.concatenate([velocity[1:2], velocity[:-1]]), np.concatenate([velocity[1:], velocity[-2:-1]])
    surprise = np.min([np.abs(change - expected * interval) for expected in (0, before, after)], axis=0)
    return surprise > _JUMP + np.minimum(_MAX_ACCELERATION * interval**2 / 4, _MAX_SPEED * interval)


def _not_astray(motion: Motion) -> Bool[np.ndarray, " samples"] | None:
    """The samples but those few between a jump away and the jump back; None where there are none of them."""
    rows = np.flatnonzero(_jumps(motion).any(axis=1))
    kept = np.ones(len(motion.time), bool)
    for first, last in itertools.pairwise(rows):
        back = np.abs(motion.qpos[last + 1] - motion.qpos[first]).max() < _JUMP
        if back and last - first <= _ASTRAY and kept[first]:
            kept[first + 1 : last + 1] = False
    return None if kept.all() else kept


def _in_range(
    name: str, motion: Motion, joint_names: Sequence[str], joint_range: Float[np.ndarray, "joints 2"], notes: Notes
) -> Motion:
    """The motion with joints rotated by full turns where only this brings them into their range.

    Raises:
      ValueError: an angle that is beyond the range by more than measurements are.
    """
    turns_on = np.ptp(joint_range, axis=1) >= FULL_TURN
    lower, upper = joint_range.T
    bounds = np.stack(
        [
            np.where(turns_on, np.minimum(lower, -_MAX_ANGLE), lower),
            np.where(turns_on, np.maximum(upper, _MAX_ANGLE), upper),
        ],
        axis=1,
    )
    middle = (motion.qpos.min(axis=0) + motion.qpos.max(axis=0)) / 2
    is_outside = np.any((motion.qpos < bounds[:, 0] - OVERSHOOT) | (motion.qpos > bounds[:, 1] + OVERSHOOT), axis=0)
    turns = np.clip(np.round((middle - bounds.mean(axis=1)) / (2 * np.pi)), -_MAX_TURNS, _MAX_TURNS)
    turns = np.where(is_outside, 2 * np.pi * turns, 0.0)
    qpos = motion.qpos - turns
    beyond = np.maximum(bounds[:, 0] - qpos, qpos - bounds[:, 1])
    sample, joint = map(int, np.unravel_index(np.argmax(beyond), beyond.shape))
    if beyond[sample, joint] > OVERSHOOT:
        lower, upper = bounds[joint]
        takes = not turns_on[joint] and abs(motion.qpos[sample, joint]) <= _MAX_ANGLE
        raise ValueError(
            f"source: {joint_names[joint]} of {name} is at {motion.qpos[sample, joint]:.4g}, "
            f"expected rad in [{lower:.4f}, {upper:.4f}]" + "; limits=none takes it" * bool(takes)
        )
    if beyond[sample, joint] > 1e-6:  # float32 rounds pi by 9e-8
        notes.add(
            "slightly beyond the joint range", f"{joint_names[joint]} of {name} by {beyond[sample, joint]:.2g} rad"
        )
    if turns.any():
        notes.add("rotated by full turns into the joint range", f"{joint_names[int(np.argmax(turns != 0))]} of {name}")
    return motion._replace(qpos=qpos)


def beyond_range(motions: Mapping[str, Motion], names: Sequence[str], ranges: np.ndarray) -> str:
    """A line about the joint that is farthest beyond the arm's own range; empty where none is."""
    low, high = (extreme([extreme(motion.qpos, axis=0) for motion in motions.values()], axis=0)
                 for extreme in (np.min, np.max))  # fmt: skip
    beyond = np.maximum(ranges[:, 0] - low, high - ranges[:, 1])
    beyond[np.ptp(ranges, axis=1) >= FULL_TURN] = -np.inf  # joints that turn on
    joint = int(np.argmax(beyond))
    text = f"{names[joint]} is up to {beyond[joint]:.2g} rad beyond the range of the expert's model"
    if beyond[joint] > _FAR_BEYOND:
        return f"warning: {text}: another arm, other units, or the order, signs or zeros of joints?"
    return text if beyond[joint] > OVERSHOOT else ""


def _checked_velocities(name: str, motion: Motion, notes: Notes) -> Motion:
    """The motion without its velocities where these are not those of its angles, as with drivers that publish zeros."""
    if motion.qvel is None or len(motion.time) < 3:
        return motion
    _, true = angles_and_velocities(motion._replace(qvel=None), motion.time)
    error, speed = (np.sqrt(np.mean(values**2, axis=0)) for values in (motion.qvel - true, true))
    wrong = error > _DISAGREEMENT * speed + _SPEED_NOISE
    if not motion.qvel.any():
        wrong = np.ptp(motion.qpos, axis=0) > OVERSHOOT
    if not wrong.any():
        return motion
    joint = int(np.argmax(wrong * error))
    stated = np.abs(motion.qvel[:, joint]).max()
    notes.add(
        "velocities computed, since the source's are not those of its angles",
        f"{name}, up to {stated:.3g} rad/s stated and {np.abs(true[:, joint]).max():.3g} rad/s true",
    )
    return motion._replace(qvel=None)
