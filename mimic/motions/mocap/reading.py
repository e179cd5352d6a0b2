"""Reads a motion capture file of any kind, with its unit, axes and rate found out and said."""

import dataclasses
import os
from pathlib import Path

import numpy as np

from mimic.base.config import check_choice
from mimic.motions.mocap.arms import find_arms
from mimic.motions.mocap.bvh import joint_positions, read_bvh
from mimic.motions.mocap.conventions import STATED_ARM_LENGTH, UNITS, UPS, arm_length, guessed_units, guessed_up, z_up
from mimic.motions.mocap.points import PointMotion
from mimic.motions.mocap.tables import Table, read_csv, read_npz, read_trc

KINDS = (".bvh", ".c3d", ".trc", ".csv", ".npz")
_UNEVEN = 1e-3  # of an interval: larger differences between times are resampled
_SYNONYMS = {
    "meters": "m",
    "meter": "m",
    "metres": "m",
    "millimeters": "mm",
    "centimeters": "cm",
    "in": "inch",
    "ft": "foot",
}
_UP = {".bvh": "y", ".trc": "y", ".c3d": "z", ".csv": "z", ".npz": "z"}  # where neither file nor body says


def read_motion(path: str | os.PathLike[str], *, unit: str = "", up: str = "") -> PointMotion:
    """Reads a motion capture file.

    Where neither the file nor an argument says: the unit is that in which the arms have the length of an adult's, and
    up is the axis from the feet to the head. Notes of the result say what was found. A unit that the file states is
    rejected where the arms are not those of a person in it.

    Args:
      path: a BVH, C3D, TRC, CSV or npz file.
      unit: "m", "dm", "cm", "mm", "inch", "foot", or "cmu" for the BVH files of the CMU database (0.0564 m).
      up: "x", "y", "z", "-x", "-y" or "-z".

    Raises:
      ValueError: no file, or one of another kind, damaged, or without a unit that can be found.
    """
    source = Path(path)
    if not source.is_file():
        raise ValueError(f"source: no file at {str(source)!r}")
    suffix = source.suffix.lower()
    if suffix not in KINDS:
        raise ValueError(f"source: expected a file that ends in {', '.join(KINDS)}, got {str(source)!r}")
    for name, value, choices in (("unit", unit, tuple(UNITS)), ("up", up, UPS)):
        if value:
            check_choice(name, value, choices)
    try:
        table, notes = _read(source, suffix)
        motion = _even(table, notes)
        stated = _stated(table.unit, UNITS)
        if stated and not unit:
            _check_stated(motion, stated)
        return _in_metres_z_up(motion, unit or stated, up or _stated(table.up, UPS), _UP[suffix])
    except (ValueError, OSError) as error:
        raise ValueError(f"source: {str(source)!r}: {error}") from error


def _read(path: Path, suffix: str) -> tuple[Table, tuple[str, ...]]:
    if suffix == ".bvh":
        bvh = read_bvh(path)
        time = np.arange(len(bvh.values)) * bvh.frame_time
        names, parents = zip(*((joint.name, joint.parent) for joint in bvh.joints), strict=True)
        return Table(names, joint_positions(bvh), time, parents=parents), bvh.notes
    if suffix == ".c3d":
        from mimic.motions.mocap.c3d import read_c3d

        return read_c3d(path), ()
    return {".trc": read_trc, ".csv": read_csv, ".npz": read_npz}[suffix](path), ()


def _even(table: Table, notes: tuple[str, ...]) -> PointMotion:
    """The motion at equal intervals."""
    interval = float(np.median(np.diff(table.time)))
    positions, rate = table.positions, (len(table.time) - 1) / (table.time[-1] - table.time[0])
    if np.abs(np.diff(table.time) - interval).max() > _UNEVEN * interval:
        rate = 1 / interval
        samples = int((table.time[-1] - table.time[0]) / interval * (1 + 1e-9)) + 1
        if samples > 10 * len(table.time):
            raise ValueError(f"time: expected samples every {interval:g} s, got gaps of more than ten times the whole")
        even = table.time[0] + np.arange(samples) * interval
        positions = _resampled(table, even, interval)
        notes += (f"times differ by up to {np.abs(np.diff(table.time) - interval).max():.3g} s: resampled",)
    parents = table.parents or (-1,) * len(table.names)
    return PointMotion(table.names, parents, positions, float(rate), notes)


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


def _in_metres_z_up(motion: PointMotion, unit: str, up: str, usual_up: str) -> PointMotion:
    notes = list(motion.notes)
    arms = find_arms(motion)
    if not unit:
        fitting = guessed_units(motion, arms)
        if len(fitting) != 1:
            lengths = ", ".join(f"{arm_length(motion, arm):.4g}" for arm in arms.values())
            units = " and in ".join(fitting) or "no unit"
            known = f"its arms have lengths of {lengths}, as an adult's in {units}" if lengths else "no arm was found"
            raise ValueError(f"unit: expected one of {', '.join(UNITS)}, since {known}")
        unit = fitting[0]
        notes.append(f"unit: {unit}, found from the length of the arms")
    if not up:
        found = guessed_up(motion)
        up = found or usual_up
        notes.append(f"up: {up}, {'from the feet to the head' if found else 'as usual for such files'}")
    positions = z_up(motion.positions, up) * UNITS[unit]
    return dataclasses.replace(motion, positions=positions, notes=tuple(notes))
