"""Reads tables of captured points: TRC (OpenSim), CSV and npz."""

import csv
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mimic.base.files import read_text
from mimic.base.npz import read_arrays
from mimic.motions.demonstrations import is_demonstrations
from mimic.motions.formats.names import UNSEEN

_MAX_POINTS = 2000
_MAX_VALUE = 1e9
_COLUMN = re.compile(r"(.+?)[ ._:]*([xyz])(?:\s*[\[(](.+)[\])])?", re.IGNORECASE)
_TIME = re.compile(r"(time|t|timestamp|seconds)([ _]*[\[(]?(s|sec|seconds|ms|us|ns)[\])]?)?", re.IGNORECASE)
_ARRAYS = ("names", "positions", "time", "rate", "parents", "unit", "up")


class Table(NamedTuple):
    """Content of a file.

    Attributes:
      names: of the points.
      positions: [time, points, 3] in the file's unit and axes; NaN where a point was not seen.
      time: [time] s.
      unit, up, rate: those that the file states, or None.
      parents: of the points, or None.
      rest: positions of a skeleton at rest [points, 3], or None.
      notes: what was corrected, one line each.
    """

    names: tuple[str, ...]
    positions: np.ndarray
    time: np.ndarray
    unit: str | None = None
    up: str | None = None
    parents: tuple[int, ...] | None = None
    rate: float | None = None
    rest: np.ndarray | None = None
    notes: tuple[str, ...] = ()


def read_trc(path: Path) -> Table:
    """Markers of a TRC file.

    Raises:
      ValueError: what is missing or wrong.
    """
    lines = read_text(path, errors="replace").splitlines()
    if len(lines) < 6 or not lines[0].lower().startswith("pathfiletype"):
        raise ValueError("expected a TRC file, which begins with PathFileType")
    separator = "\t" if "\t" in lines[3] else ","
    header = dict(zip(*(re.split(r"[\s,]+", line.strip()) for line in lines[1:3]), strict=False))
    names = tuple(name.strip() for name in lines[3].split(separator)[2:] if name.strip())
    rows = [line.split(separator) for line in lines[5:] if line.strip(f" {separator}")]
    columns = 2 + 3 * len(names)
    values = _cells([(row + [""] * columns)[:columns] for row in rows], "TRC")
    positions = values[:, 2:].reshape(len(rows), len(names), 3)
    rate, frames = (_stated_number(header.get(key, "")) for key in ("DataRate", "NumFrames"))
    notes = frames_note(int(frames), len(rows)) if frames else ()
    return _checked(Table(names, positions, values[:, 1], header.get("Units") or None, rate=rate or None, notes=notes))


def frames_note(stated: int, found: int) -> tuple[str, ...]:
    """A line where a file has another number of frames than its header states, as one that is cut off."""
    return () if stated == found else (f"the header states {stated} frames, the file has {found}",)


def _stated_number(text: str) -> float:
    """A number of a header above 0; 0 for anything else."""
    return max(float(text), 0.0) if _is_number(text) and abs(float(text)) <= _MAX_VALUE else 0.0


def read_csv(path: Path) -> Table:
    """Points of a CSV table: a column of times, and three columns for each point, as in `wrist_x, wrist_y, wrist_z`.

    A unit may follow, as in `wrist_x [mm]`. Lines that begin with `#` are comments.

    Raises:
      ValueError: what is missing or wrong.
    """
    lines = [line for line in read_text(path, errors="replace").splitlines() if not line.startswith("#")]
    separator = max(",;\t", key=(lines or [""])[0].count)
    reader = csv.reader(lines, delimiter=separator)
    try:
        header = [name.strip() for name in next(reader, [])]
        rows = [row for row in reader if row]
    except csv.Error as error:
        raise ValueError(f"it is not a CSV table: {error}") from error
    time = [i for i, name in enumerate(header) if _TIME.fullmatch(name)]
    columns: dict[str, dict[str, int]] = {}
    units: dict[str, None] = {}
    for index, name in enumerate(header):
        if index not in time and (match := _COLUMN.fullmatch(name)):
            columns.setdefault(match[1], {})[match[2].lower()] = index
            units |= {match[3].strip(): None} if match[3] else {}
    points = {name: axes for name, axes in columns.items() if len(axes) == 3}
    if not time or not points:
        raise ValueError(
            f"expected a column 'time' and, for each point, NAME_x, NAME_y, NAME_z; got {', '.join(header)[:200]!r}"
        )
    if len(units) > 1:
        raise ValueError(f"expected all points in one unit, got {', '.join(units)}")
    if any(len(row) != len(header) for row in rows):
        raise ValueError(f"expected {len(header)} cells in each row")
    values = _cells(rows, "CSV", [time[0], *(axes[a] for axes in points.values() for a in "xyz")])
    positions = values[:, 1:].reshape(len(rows), len(points), 3)
    return _checked(Table(tuple(points), positions, values[:, 0], next(iter(units), None)))


def read_npz(path: Path) -> Table:
    """Points of an npz file: names [points], positions [time, points, 3], and time [time] in s or rate [1/s].

    It may have `parents` [points], `unit` and `up`.

    Raises:
      ValueError: what is missing or wrong.
    """
    content = read_arrays(path, _ARRAYS)
    if not {"names", "positions"} <= content.keys() or not content.keys() & {"time", "rate"}:
        joints = "demonstrations of an arm's joints; those need no arm=" if is_demonstrations(path) else "others"
        raise ValueError(f"expected points as names, positions, and time or rate, got {joints}")
    positions, names = content["positions"], content["names"]
    if names.ndim != 1 or names.dtype.kind != "U":
        raise ValueError(f"names: expected a list of texts, got {names.dtype} of shape {names.shape}")
    if positions.dtype.kind not in "fiu" or positions.shape[1:] != (len(names), 3) or positions.ndim != 3:
        raise ValueError(f"positions: expected numbers [time, {len(names)} points, 3], got {positions.shape}")
    stated = None
    if "time" in content:
        time = content["time"]
    else:
        rate = content["rate"]
        if rate.size != 1 or rate.dtype.kind not in "fiu" or not 0.1 <= rate.item() <= 1e5:
            raise ValueError("rate: expected samples per second, from 0.1 to 1e5")
        stated = float(rate.item())
        time = np.arange(len(positions)) / stated
    if time.dtype.kind not in "fiu" or time.shape != positions.shape[:1]:
        raise ValueError(f"time: expected {len(positions)} numbers, got shape {time.shape}")
    parents = _parents(content["parents"], len(names)) if "parents" in content else None
    texts: dict[str, Any] = {key: str(content[key]) for key in ("unit", "up") if key in content}
    values = positions.astype(float), time.astype(float)
    return _checked(Table(tuple(map(str, names)), *values, parents=parents, rate=stated, **texts))


def _parents(parents: np.ndarray, points: int) -> tuple[int, ...]:
    if (
        parents.shape != (points,)
        or parents.dtype.kind not in "iu"
        or np.any(parents >= np.arange(points))
        or np.any(parents < -1)
    ):
        raise ValueError(f"parents: expected the index of an earlier point, or -1, for each of {points} points")
    return tuple(map(int, parents))


def _checked(table: Table) -> Table:
    """The table, if its names, values and times can be those of a motion; of points with one name the first."""
    if not table.names or len(table.names) > _MAX_POINTS:
        raise ValueError(f"expected 1 to {_MAX_POINTS} points, got {len(table.names)}")
    if len(table.time) < 2:
        raise ValueError(f"expected at least 2 samples, got {len(table.time)}")
    if not np.all(np.isfinite(table.time)) or np.any(np.diff(table.time) < 0):
        raise ValueError("time: expected finite numbers that rise from row to row")
    with np.errstate(invalid="ignore"):
        if np.any(np.abs(table.positions) > _MAX_VALUE):
            raise ValueError(f"positions: expected numbers of at most {_MAX_VALUE:g}")
    table = table._replace(positions=np.where(np.isfinite(table.positions), table.positions, np.nan))
    if table.parents is None:
        table = _without_placeholders(_without_doubles(table))
    elif len(set(table.names)) != len(table.names):
        raise ValueError("expected different names of the joints of a skeleton")
    return table


def _without_doubles(table: Table) -> Table:
    first = list({name: table.names.index(name) for name in table.names}.values())
    if len(first) == len(table.names):
        return table
    twice = ", ".join(sorted({name for name in table.names if table.names.count(name) > 1}))
    note = f"names that occur twice, of which the first point is read: {twice}"
    names = tuple(table.names[i] for i in first)
    return table._replace(names=names, positions=table.positions[:, first], notes=(*table.notes, note))


def _without_placeholders(table: Table) -> Table:
    """The table without positions of three equal numbers, as 0 or 9999999: tools write them for what was not seen."""
    placeholder = (table.positions == table.positions[..., :1]).all(axis=2)
    if not placeholder.any():
        return table
    values = sorted({f"{value:g}" for value in np.unique(table.positions[placeholder])[:3]})
    note = f"not seen: {placeholder.sum()} positions whose three coordinates are equal ({', '.join(values)})"
    positions = np.where(placeholder[..., None], np.nan, table.positions)
    return table._replace(positions=positions, notes=(*table.notes, note))


def _cells(rows: list[list[str]], what: str, columns: list[int] | None = None) -> np.ndarray:
    """Numbers of cells; NaN for those of a point that was not seen."""
    if not rows:
        raise ValueError("expected at least 2 samples, got 0")
    chosen = rows if columns is None else [[row[column] for column in columns] for row in rows]
    cells = ["nan" if cell.strip().lower() in UNSEEN else cell for row in chosen for cell in row]
    return numbers(cells, what).reshape(len(chosen), -1)


def numbers(words: list[str], where: str) -> np.ndarray:
    """The numbers that words state.

    Raises:
      ValueError: one is no number.
    """
    try:
        return np.array(words, float)
    except ValueError:
        wrong = next(word for word in words if not _is_number(word))
        point = ", with decimal points" if re.fullmatch(r"-?\d+,\d+", wrong.strip()) else ""
        raise ValueError(f"{where}: expected numbers{point}, got {wrong!r:.60}") from None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
