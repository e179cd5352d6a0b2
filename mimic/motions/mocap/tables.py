"""Reads tables of captured points: TRC (OpenSim), CSV and npz."""

import csv
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mimic.base.files import read_text
from mimic.base.npz import read_arrays

_MAX_POINTS = 2000
_MAX_VALUE = 1e9
_COLUMN = re.compile(r"(.+?)[ ._:]?([xyz])", re.IGNORECASE)
_TIME = ("time", "t", "timestamp", "time [s]")
_ARRAYS = ("names", "positions", "time", "rate", "parents", "unit", "up")


class Table(NamedTuple):
    """Content of a file.

    Attributes:
      names: of the points.
      positions: [time, points, 3] in the file's unit and axes; NaN where a point was not seen.
      time: [time] s.
      unit, up: those that the file states, or None.
      parents: of the points, or None.
    """

    names: tuple[str, ...]
    positions: np.ndarray
    time: np.ndarray
    unit: str | None = None
    up: str | None = None
    parents: tuple[int, ...] | None = None


def read_trc(path: Path) -> Table:
    """Markers of a TRC file.

    Raises:
      ValueError: what is missing or wrong.
    """
    lines = read_text(path, errors="replace").splitlines()
    if len(lines) < 6 or not lines[0].lower().startswith("pathfiletype"):
        raise ValueError("expected a TRC file, which begins with PathFileType")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    names = tuple(name.strip() for name in lines[3].split("\t")[2:] if name.strip())
    rows = [line.split("\t") for line in lines[5:] if line.strip()]
    columns = 2 + 3 * len(names)
    values = _numbers([(row + [""] * columns)[:columns] for row in rows], "TRC")
    positions = values[:, 2:].reshape(len(rows), len(names), 3)
    return _checked(Table(names, positions, values[:, 1], unit=header.get("Units", "").strip() or None))


def read_csv(path: Path) -> Table:
    """Points of a CSV table: a column of times, and three columns for each point, as in `wrist_x, wrist_y, wrist_z`.

    Raises:
      ValueError: what is missing or wrong.
    """
    reader = csv.reader(read_text(path, errors="replace").splitlines())
    try:
        header = [name.strip() for name in next(reader, [])]
        rows = [row for row in reader if row]
    except csv.Error as error:
        raise ValueError(f"it is not a CSV table: {error}") from error
    time = [i for i, name in enumerate(header) if name.lower() in _TIME]
    columns: dict[str, dict[str, int]] = {}
    for index, name in enumerate(header):
        if index not in time and (match := _COLUMN.fullmatch(name)):
            columns.setdefault(match[1], {})[match[2].lower()] = index
    points = {name: axes for name, axes in columns.items() if len(axes) == 3}
    if not time or not points:
        raise ValueError("expected a column 'time' and, for each point, NAME_x, NAME_y, NAME_z")
    if any(len(row) != len(header) for row in rows):
        raise ValueError(f"expected {len(header)} cells in each row")
    values = _numbers(rows, "CSV", [time[0], *(axes[a] for axes in points.values() for a in "xyz")])
    return _checked(Table(tuple(points), values[:, 1:].reshape(len(rows), len(points), 3), values[:, 0]))


def read_npz(path: Path) -> Table:
    """Points of an npz file: names [points], positions [time, points, 3], and time [time] in s or rate [1/s].

    It may have `parents` [points], `unit` and `up`.

    Raises:
      ValueError: what is missing or wrong.
    """
    content = read_arrays(path, _ARRAYS)
    if not {"names", "positions"} <= content.keys() or not content.keys() & {"time", "rate"}:
        raise ValueError("expected names, positions, and time or rate")
    positions, names = content["positions"], content["names"]
    if names.ndim != 1 or names.dtype.kind != "U":
        raise ValueError(f"names: expected a list of texts, got {names.dtype} of shape {names.shape}")
    if positions.dtype.kind not in "fiu" or positions.shape[1:] != (len(names), 3) or positions.ndim != 3:
        raise ValueError(f"positions: expected numbers [time, {len(names)} points, 3], got {positions.shape}")
    if "time" in content:
        time = content["time"]
    else:
        rate = content["rate"]
        if rate.shape or rate.dtype.kind not in "fiu" or not 0.1 <= rate <= 1e5:
            raise ValueError("rate: expected samples per second, from 0.1 to 1e5")
        time = np.arange(len(positions)) / float(rate)
    if time.dtype.kind not in "fiu" or time.shape != positions.shape[:1]:
        raise ValueError(f"time: expected {len(positions)} numbers, got shape {time.shape}")
    parents = _parents(content["parents"], len(names)) if "parents" in content else None
    texts = {key: str(content[key]) for key in ("unit", "up") if key in content}
    return _checked(
        Table(tuple(map(str, names)), positions.astype(float), time.astype(float), parents=parents, **texts)
    )


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
    """The table, if its names, values and times can be those of a motion."""
    if not table.names or len(table.names) > _MAX_POINTS:
        raise ValueError(f"expected 1 to {_MAX_POINTS} points, got {len(table.names)}")
    if len(set(table.names)) != len(table.names):
        twice = next(name for name in table.names if table.names.count(name) > 1)
        raise ValueError(f"expected different names, got {twice!r:.60} twice")
    if len(table.time) < 2:
        raise ValueError(f"expected at least 2 samples, got {len(table.time)}")
    if not np.all(np.isfinite(table.time)) or np.any(np.diff(table.time) <= 0):
        raise ValueError("time: expected finite numbers that rise from row to row")
    with np.errstate(invalid="ignore"):
        if np.any(np.abs(table.positions) > _MAX_VALUE):
            raise ValueError(f"positions: expected numbers of at most {_MAX_VALUE:g}")
    return table._replace(positions=np.where(np.isfinite(table.positions), table.positions, np.nan))


def _numbers(rows: list[list[str]], what: str, columns: list[int] | None = None) -> np.ndarray:
    """Numbers of cells; NaN for empty ones."""
    if not rows:
        raise ValueError("expected at least 2 samples, got 0")
    chosen = rows if columns is None else [[row[column] for column in columns] for row in rows]
    try:
        return np.array([[cell.strip() or "nan" for cell in row] for row in chosen], float)
    except ValueError as error:
        raise ValueError(f"{what}: expected numbers, got {' '.join(str(error).split()[-3:])!r:.60}") from error
