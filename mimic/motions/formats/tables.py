"""Reads joint motions from tables of text: CSV, TSV, and a folder with a table for each quantity."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mimic.motions.formats.cells import Cells, read_cells
from mimic.motions.formats.episodes import ANGLE, VELOCITY, Motion, Quantity, Recording
from mimic.motions.formats.names import (
    QUANTITIES,
    SECONDS,
    Column,
    Selection,
    common_unit,
    hand_position,
    parse_column,
    select,
)

TABLES = tuple(suffix + packed for suffix in (".csv", ".tsv", ".txt", ".dat") for packed in ("", ".gz"))
TIMES = ("time", "times", "t", "timestamp", "timestamps", "stamp", "elapsed", "seconds", "sec")
_DEMONSTRATIONS = ("demonstration", "demo", "episode", "episode_index", "trajectory", "trial")
_CLOCKS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))  # units of times that large: a clock's, since 1970
_SLOWEST = 0.99  # s between samples: with more, they are in another unit, or no motion


class _Content(NamedTuple):
    """Names of columns, what they are, numbers, places of time and number, motion of each row, and assumptions."""

    names: list[str]
    columns: list[Column]
    table: np.ndarray
    time_at: int | None
    number_at: int | None
    episodes: list[str]
    notes: list[str]


def read_table(path: Path, joints: Sequence[str], rate: float | None = None) -> Recording:
    """The motions of joints, one for each number in the column `demonstration`.

    Cells are separated by commas, semicolons, tabs or blanks; a comma that separates none is a decimal point. A
    header has the columns `time` and, for each joint, its angle: its name, `q_NAME`, `NAME.pos` or `q_1`, `q_2`, ...
    by number; and optionally velocities, as `qdot_NAME`. Units may follow, as in `elbow [deg]`. Without a header the
    columns are time, angles, and optionally velocities, of all joints in their order.

    Args:
      path: the table.
      joints: names of the joints, base to tip.
      rate: samples per second, where the table does not state times, or others.

    Raises:
      ValueError: no table of numbers, or one that lacks columns.
    """
    text = read_cells(path)
    content = _content(path, text, len(joints), not rate)
    columns, table, notes = content.columns, content.table, content.notes
    time_at, number_at = content.time_at, content.number_at
    names = {
        quantity: {column.joint: i for i, column in enumerate(columns) if column.quantity == quantity}
        for quantity in (ANGLE, VELOCITY)
    }
    reserved = [column.joint for i, column in enumerate(columns) if i in (time_at, number_at)]
    angles = {name: index for name, index in names[ANGLE].items() if name not in reserved}
    if time_at is None and not rate:
        raise ValueError(
            f"source: {str(path)!r} lacks time; got the columns {', '.join(text.header)}; rate= states samples per "
            "second"
        )
    if not len(table):
        raise ValueError(f"source: {str(path)!r} has no rows")
    selection = select(str(path), {"columns": list(angles)}, joints, "", "table")
    if words := [name for name in selection.joints if not np.isfinite(table[:, angles[name]]).any()]:
        raise ValueError(f"source: {str(path)!r} has no number in the column of {words[0]}")
    held = [(column.joint, column.quantity) for column in columns]
    if twice := [name for name in selection.joints if max(held.count((name, of)) for of in names) > 1]:
        raise ValueError(f"source: {str(path)!r} has several columns with the name of {twice[0]}; expected one")
    time, line = np.arange(len(table)) / (rate or 1), ""
    if time_at is not None and not rate:
        time, line = seconds(path, table[:, time_at], unit_of_time(columns[time_at]))
    elif rate and time_at is not None:
        line = line_of_rate(rate, content.names[time_at])
    qvel = _velocities(path, table, names[VELOCITY], selection)
    gripper = table[:, [angles[name] for name in selection.gripper]] if selection.gripper else None
    found = hand_position({"": list(angles)})
    hand = table[:, [angles[name] for name in found[1]]] if found else None
    motion = Motion(time, table[:, [angles[name] for name in selection.joints]], qvel, gripper, hand)
    labels = np.array(content.episodes)
    motions = {label: motion.take(labels == label) for label in dict.fromkeys(content.episodes)}
    unit = common_unit(str(path), {name: columns[angles[name]].unit for name in selection.joints})
    lines = (*notes, *selection.notes, *filter(None, [line]))
    return Recording(motions, unit=unit, notes=lines, **selection.facts)


def line_of_rate(rate: float, name: str) -> str:
    """The line about times that the user's replace."""
    return f"times: {rate:g} samples a second, as rate= says, and not those of {name}"


def rows_of_table(path: Path, joints: int, timed: bool) -> tuple[Cells, list[str], list[str]]:
    """A table's text, the names of its columns, and the motion to which each row belongs; see `read_table`."""
    text = read_cells(path)
    content = _content(path, text, joints, timed)
    return text, content.names, content.episodes


def _content(path: Path, text: Cells, joints: int, timed: bool) -> _Content:
    """The numbers of a table, and what its columns are."""
    names, notes = text.header, []
    if not names:
        names, notes = _default_names(path, text.table.shape[1], joints, timed)
    columns = [parse_column(name) for name in names]
    time_at, number_at = (
        next((i for i, column in enumerate(columns) if _word(column.joint) in words), None)
        for words in (TIMES, _DEMONSTRATIONS)
    )
    numbers = np.zeros(len(text.table)) if number_at is None else text.table[:, number_at]
    episodes = [f"demonstration {number:g}" for number in numbers]
    return _Content(names, columns, text.table, time_at, number_at, episodes, notes)


def is_folder_of_tables(path: Path) -> bool:
    """Whether a folder has tables of angles and of times, one for each quantity, as their names say."""
    return {"time", ANGLE} <= set(tables_by_quantity(path)) if path.is_dir() else False


def read_folder_of_tables(folder: Path, joints: Sequence[str]) -> Recording:
    """The motion in a folder with a table for the angles, one for the times, and optionally one for the velocities.

    The word `position`, `time` or `velocity` is in the name of each file. A table has no header, and a sample of all
    joints in a row, or in as many rows as there are joints.

    Raises:
      ValueError: tables of other sizes.
    """
    tables = {quantity: read_cells(path).table for quantity, path in tables_by_quantity(folder).items()}
    count, notes = tables["time"].size, []
    arrays: dict[Quantity, np.ndarray] = {}
    for quantity in (ANGLE, VELOCITY):
        if quantity in tables:
            table = tables[quantity]
            if table.size != count * len(joints):
                raise ValueError(
                    f"source: {str(folder)!r} has {count} times and {table.size} numbers as {quantity.name}, "
                    f"expected {count} of each of {', '.join(joints)}"
                )
            arrays[quantity] = table.reshape(count, len(joints))
    notes.append(f"joints: the numbers of a sample in their order, as {', '.join(joints)}")
    time, line = seconds(folder, tables["time"].ravel(), "")
    motion = Motion(time, arrays[ANGLE], arrays.get(VELOCITY))
    lines = (*notes, *filter(None, [line]))
    return Recording({"demonstration 0": motion}, notes=lines, entry=ANGLE.name, joints=tuple(joints))


def tables_by_quantity(folder: Path) -> dict[Quantity | str, Path]:
    """The tables of a folder by quantity, or "time"; none where two have the same."""
    found: dict[Quantity | str, Path] = {}
    for path in sorted(folder.iterdir()):
        words = re.split(r"[^a-z]+", path.name.lower().split(".")[0])
        kinds = ["time" for word in words if word in TIMES] + [QUANTITIES[word] for word in words if word in QUANTITIES]
        if path.name.lower().endswith(TABLES) and len(kinds) == 1:
            if kinds[0] in found:
                return {}
            found[kinds[0]] = path
    return found


def _default_names(path: Path, count: int, joints: int, timed: bool) -> tuple[list[str], list[str]]:
    """Columns of a table without a header (time, angles, and the velocities and torques that there are), and a line."""
    blocks = {1: "angles", 2: "angles and velocities", 3: "angles, velocities and torques"}
    quantities = blocks.get((count - timed) // joints)
    if (count - timed) % joints or not quantities:
        raise ValueError(
            f"source: {str(path)!r} has no header and {count} columns; expected time and the angles of {joints} "
            f"joints, optionally their velocities: {joints + 1} or {2 * joints + 1} columns, or one less and rate="
        )
    names = [f"{word}_{number + 1}" for word in ("q", "dq", "tau") for number in range(joints)]
    names = ["time", *names] if timed else names
    note = f"no header: the columns are {'time, then ' * timed}the {quantities} of {joints} joints"
    return names[:count], [note]


def _word(name: str) -> str:
    """The last word of a column's name, without its unit: `time` of `/clock/time_ms`."""
    words = [word for word in re.split(r"[^a-z]+", name.lower()) if word and word not in SECONDS]
    return words[-1] if words else name.lower()


def is_time(column: Column) -> bool:
    """Whether a column or data set has times, by its name."""
    return _word(column.joint) in TIMES


def unit_of_time(column: Column) -> str:
    """The unit of a column of times, by its name: `time [ms]`, `time_ms`; empty for none."""
    last = re.split(r"[^a-zµ]+", column.joint.lower())[-1]
    return column.unit or (last if last in SECONDS else "")


def seconds(path: Path, time: np.ndarray, unit: str) -> tuple[np.ndarray, str]:
    """Times in s, from a unit that is stated, or from the size of a clock's; and a line about what was found."""
    if len(time) and not np.isfinite(time).any():
        raise ValueError(f"source: {str(path)!r} has no number as time, nor dates as 2024-05-01T12:00:00.5")
    line = ""
    if not unit and len(time):
        unit = next((unit for least, unit in _CLOCKS if np.nanmax(np.abs(time)) >= least), "")
        line = f"times: in {unit}, as those of a clock since 1970" if unit else ""
    if unit not in SECONDS:
        raise ValueError(
            f"source: the times of {str(path)!r} are in {unit!r}, expected {', '.join(filter(None, SECONDS))}"
        )
    seconds = (time - time[np.isfinite(time)][:1]) * SECONDS[unit]
    if len(time) > 1 and not (interval := float(np.nanmedian(np.diff(seconds)))) < _SLOWEST:
        raise ValueError(
            f"source: the samples of {str(path)!r} are {interval:g} s apart, expected less than {_SLOWEST:g} s; times "
            "in another unit are called time_ms, time_us or time_ns"
        )
    return seconds, line


def _velocities(path: Path, table: np.ndarray, velocities: dict[str, int], selection: Selection) -> np.ndarray | None:
    """The velocities of joints; None without any.

    Raises:
      ValueError: only some joints have them.
    """
    missing = [name for name in selection.joints if name not in velocities]
    if missing and len(missing) < len(selection.joints):
        raise ValueError(f"source: {str(path)!r} has velocities of some joints, but none of {', '.join(missing)}")
    return None if missing else table[:, [velocities[name] for name in selection.joints]]
