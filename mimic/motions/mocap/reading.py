"""Reads a motion capture file of any kind, with its unit, axes and rate found out and said."""

import dataclasses
import os
from pathlib import Path

import numpy as np

from mimic.base.config import check_choice
from mimic.motions.mocap.arms import find_arms, find_facing, persons, unnamed
from mimic.motions.mocap.bvh import joint_positions, read_bvh, rest_positions
from mimic.motions.mocap.conventions import (
    STATED_ARM_LENGTH,
    UNITS,
    UPS,
    arm_length,
    find_up,
    guessed_units,
    looks_mirrored,
    mean_point,
    z_up,
)
from mimic.motions.mocap.names import parts_of
from mimic.motions.mocap.points import GAP, ArmPoints, PointMotion, intervals, median_length
from mimic.motions.mocap.tables import Table, read_csv, read_npz, read_trc

KINDS = (".bvh", ".c3d", ".trc", ".csv", ".npz")
_UNEVEN = 1e-3  # of an interval: larger differences between times are resampled
_RATES = 5.0, 5000.0  # 1/s; of a capture, in a unit of time that is not stated
_TIMES = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_SYNONYMS = {
    "meters": "m",
    "meter": "m",
    "metres": "m",
    "millimeters": "mm",
    "centimeters": "cm",
    "in": "inch",
    "ft": "foot",
}
_FROZEN = 0.03  # m, by which the joint before a marker moves while this one stands still
_STRETCH = 0.3  # of a length: no arm changes by more
_UP = {".bvh": "y", ".trc": "y", ".c3d": "z", ".csv": "z", ".npz": "z"}  # where neither file nor body says


def read_motion(
    path: str | os.PathLike[str],
    *,
    unit: str = "",
    up: str = "",
    subject: str = "",
    arm: ArmPoints | None = None,
    key: str = "source",
) -> PointMotion:
    """Reads a motion capture file.

    Where neither the file nor an argument says: the unit is that in which the arms have the length of an adult's, and
    up is found by `find_up`. Notes of the result say what was found. A unit that the file states is rejected where the
    arms are not those of a person in it.

    Args:
      path: a BVH, C3D, TRC, CSV or npz file.
      unit: "m", "dm", "cm", "mm", "inch", "foot", or "cmu" for the BVH files of the CMU database (0.0564 m).
      up: "x", "y", "z", "-x", "-y" or "-z".
      subject: the person to read, of several: the prefix of its points, or the root of its skeleton. "": the first.
      arm: names of points of an arm, in place of those that are found; no names where they are found.
      key: name of the path in errors.

    Raises:
      ValueError: no file, or one of another kind, damaged, or without a unit that can be found.
    """
    source = Path(path)
    if not source.is_file():
        raise ValueError(f"{key}: no file at {str(source)!r}")
    suffix = source.suffix.lower()
    if suffix not in KINDS:
        raise ValueError(f"{key}: expected a file that ends in {', '.join(KINDS)}, got {str(source)!r}")
    for name, value, choices in (("unit", unit, tuple(UNITS)), ("up", up, UPS)):
        if value:
            check_choice(name, value, choices)
    try:
        table = _read(source, suffix)
        motion = with_arm(one_person(_even(_in_seconds(table)), subject), arm)
        stated = _stated(table.unit, UNITS)
        if stated and not unit:
            _check_stated(motion, stated)
        if not up:
            rest = None if table.rest is None else table.rest[[table.names.index(name) for name in motion.names]]
            up, how = find_up(motion, _UP[suffix], _stated(table.up, UPS), rest)
            motion = _noted(motion, f"up: {up}, {how}")
        return _without_stretched(_without_frozen(_in_metres_z_up(motion, unit or stated, up)))
    except (ValueError, OSError) as error:
        raise ValueError(f"{key}: {str(source)!r}: {error}") from error


def _read(path: Path, suffix: str) -> Table:
    if suffix == ".bvh":
        bvh = read_bvh(path)
        time = np.arange(len(bvh.values)) * bvh.frame_time
        names, parents = zip(*((joint.name, joint.parent) for joint in bvh.joints), strict=True)
        return Table(
            names, joint_positions(bvh), time, parents=parents, rate=1 / bvh.frame_time, notes=bvh.notes,
            rest=rest_positions(bvh),
        )  # fmt: skip
    if suffix == ".c3d":
        from mimic.motions.mocap.c3d import read_c3d

        return read_c3d(path)
    return {".trc": read_trc, ".csv": read_csv, ".npz": read_npz}[suffix](path)


def _noted(motion: PointMotion, note: str) -> PointMotion:
    return dataclasses.replace(motion, notes=(*motion.notes, note))


def _in_seconds(table: Table) -> Table:
    """The table with times in seconds, where theirs can only be a smaller unit."""
    interval = float(np.median(np.diff(table.time)))
    if interval <= 1:
        return table
    for name, unit in _TIMES.items():
        if _RATES[0] <= 1 / (interval * unit) <= _RATES[1]:
            time = (table.time - table.time[0]) * unit
            return table._replace(time=time, notes=(*table.notes, f"time: taken for {name}"))
    return table


def _even(table: Table) -> PointMotion:
    """The motion at equal intervals."""
    parents = table.parents or (-1,) * len(table.names)
    count, span = len(table.time), float(table.time[-1] - table.time[0])
    steps = np.diff(table.time)
    if not table.rate and not np.all(steps > 0):
        raise ValueError("time: expected numbers that rise from row to row")
    interval = float(np.median(steps))
    for rate in (table.rate, (count - 1) / span if span > 0 else None):
        if rate and (_is_even(table.time, rate) or np.abs(steps - 1 / rate).max() <= _UNEVEN / rate):
            return PointMotion(table.names, parents, table.positions, float(rate), table.notes)
    if not np.all(steps > 0):
        raise ValueError(
            f"time: expected numbers that rise from row to row, or samples at the {table.rate:g} Hz stated"
        )
    samples = int(span / interval * (1 + 1e-9)) + 1
    if samples > 10 * count:
        raise ValueError(f"time: expected samples every {interval:g} s, got gaps of more than ten times the whole")
    positions = _resampled(table, table.time[0] + np.arange(samples) * interval, interval)
    notes = (*table.notes, f"times differ by up to {np.abs(steps - interval).max():.3g} s: resampled")
    return PointMotion(table.names, parents, positions, 1 / interval, notes)


def _is_even(time: np.ndarray, rate: float) -> bool:
    """Whether times are those of a rate, as far as they are rounded."""
    deviation = np.abs(time - time[0] - np.arange(len(time)) / rate).max()
    digits = next((n for n in range(9) if np.allclose(time, np.round(time, n), rtol=0, atol=1e-9)), 9)
    return bool(deviation <= min(1.01 * 10.0**-digits, 3 / rate))


def _resampled(table: Table, even: np.ndarray, interval: float) -> np.ndarray:
    """Positions at other times, linear between samples that are at most 1.5 intervals apart, otherwise NaN."""
    right = np.clip(np.searchsorted(table.time, even), 1, len(table.time) - 1)
    start, stop = table.time[right - 1], table.time[right]
    fraction = np.clip((even - start) / (stop - start), 0, 1)[:, None, None]
    positions = (1 - fraction) * table.positions[right - 1] + fraction * table.positions[right]
    positions[stop - start > 1.5 * interval] = np.nan
    return positions


def _stated(value: str | None, choices: object) -> str:
    """What a file states, if it is one of the choices."""
    text = (value or "").strip().lower()
    text = _SYNONYMS.get(text, text)
    return text if text in choices else ""  # type: ignore[operator]


def _check_stated(motion: PointMotion, unit: str) -> None:
    """Rejects a stated unit in which the arms are not those of a person: many tools state one that is not used."""
    lengths = [arm_length(motion, arm) * UNITS[unit] for arm in find_arms(motion).values()]
    known = [length for length in lengths if np.isfinite(length)]
    minimum, maximum = STATED_ARM_LENGTH
    if not all(minimum <= length <= maximum for length in known):
        raise ValueError(
            f"unit: the file states {unit}, in which its arms have lengths of "
            f"{', '.join(f'{length:.3g}' for length in known)} m; expected {minimum} to {maximum} m, or a unit for it "
            "(capture.unit=)"
        )


def one_person(motion: PointMotion, subject: str) -> PointMotion:
    """The points of one of several persons, with those that are no other person's; see `read_motion`.

    Raises:
      ValueError: there is no such person.
    """
    found = persons(motion)
    subject = next((name for name in found if name.lower() == subject.lower()), subject)
    if subject and subject not in found:
        raise ValueError(f"subject: expected one of {', '.join(map(repr, found)) or 'none'}, got {subject!r}")
    if len(found) < 2:
        return motion
    chosen = subject or next(iter(found))
    others = {index for name, indices in found.items() if name != chosen for index in indices}
    motion = motion.subset([index for index in range(len(motion.names)) if index not in others])
    return _noted(motion, f"persons: {', '.join(found)}, of which {chosen} is read (capture.subject=)")


def with_arm(motion: PointMotion, arm: ArmPoints | None) -> PointMotion:
    """The motion with the points of an arm that the user names; see `read_motion`.

    Raises:
      ValueError: there is no such point, or the arm is not complete.
    """
    if arm is None:
        return motion
    named = [tuple(_full_name(motion, name) for name in group) for group in arm[1:]]
    sides = [part.side for part in parts_of([name for group in named for name in group]) if part and part.side]
    side = arm.side or (sides or ["right"])[0]
    found = find_arms(motion).get(side, ArmPoints(side, (), (), (), ()))
    groups = [own or other for own, other in zip(named, found[1:], strict=True)]
    if not all(groups[:3]):
        raise ValueError(f"arm: expected shoulder, elbow and wrist of the {side} arm, {unnamed(motion)}")
    return dataclasses.replace(motion, named=ArmPoints(side, *groups))


def _full_name(motion: PointMotion, name: str) -> str:
    """A point by its name, also without a prefix that ends in a colon."""
    full = [point for point in motion.names if point.split(":")[-1] == name]
    return full[0] if name not in motion.names and len(full) == 1 else motion.names[motion.index(name)]


def _without_frozen(motion: PointMotion) -> PointMotion:
    """The motion without markers that stand still to the bit while the joint before them moves, as in filled gaps."""
    positions, wrong = motion.positions.copy(), np.zeros(len(motion.positions), bool)
    arms = () if any(parent >= 0 for parent in motion.parents) else find_arms(motion).values()
    for arm in arms:
        for proximal, distal in ((arm.shoulder, arm.elbow), (arm.elbow, arm.wrist), (arm.wrist, arm.hand)):
            before = mean_point(motion, proximal)
            for name in distal:
                for start, count in intervals(np.all(np.diff(motion.point(name), axis=0) == 0, axis=1)):
                    moved = np.ptp(before[start : start + count + 1], axis=0).max()
                    if count > GAP * motion.rate and moved > _FROZEN:
                        positions[start + 1 : start + count + 1, motion.index(name)] = np.nan
                        wrong[start + 1 : start + count + 1] = True
    if not wrong.any():
        return motion
    note = f"left out: {wrong.sum()} samples at which a marker stands still while the arm moves"
    return _noted(dataclasses.replace(motion, positions=positions), note)


def _without_stretched(motion: PointMotion) -> PointMotion:
    """The motion without the elbows and wrists that are too far from the joint before: exchanged or frozen markers."""
    positions, wrong = motion.positions.copy(), np.zeros(len(motion.positions), bool)
    for arm in find_arms(motion).values():
        for proximal, distal in ((arm.shoulder, arm.elbow), (arm.elbow, arm.wrist)):
            span = mean_point(motion, distal) - mean_point(motion, proximal)
            usual = median_length(span)
            is_wrong = np.abs(np.linalg.norm(span, axis=1) - usual) > _STRETCH * usual
            positions[np.ix_(is_wrong, [motion.index(name) for name in distal])] = np.nan
            wrong |= is_wrong
    if not wrong.any():
        return motion
    note = (
        f"left out: {wrong.sum()} samples at which an arm's length differs by more than {_STRETCH:.0%} from its usual"
    )
    return _noted(dataclasses.replace(motion, positions=positions), f"{note} one; markers may be exchanged or frozen")


def _in_metres_z_up(motion: PointMotion, unit: str, up: str) -> PointMotion:
    if not unit:
        arms = find_arms(motion)
        fitting = guessed_units(motion, arms)
        if len(fitting) != 1:
            lengths = ", ".join(f"{arm_length(motion, arm):.4g}" for arm in arms.values())
            units = " and in ".join(fitting) or "no unit"
            known = f"its arms have lengths of {lengths}, as an adult's in {units}" if lengths else unnamed(motion)
            raise ValueError(f"unit: expected one of {', '.join(UNITS)}, since {known}")
        unit = fitting[0]
        motion = _noted(motion, f"unit: {unit}, found from the length of the arms")
    motion = dataclasses.replace(motion, positions=z_up(motion.positions, up) * UNITS[unit])
    if looks_mirrored(motion, find_facing(motion)):
        motion = _noted(motion, "left and right are exchanged, or the file is mirrored: the toes point backwards")
    return motion
