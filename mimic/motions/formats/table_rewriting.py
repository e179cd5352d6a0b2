"""Writes tables of text and npz files again for another arm; all other columns and arrays stay as they are."""

import gzip
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mimic.base.npz import read_arrays
from mimic.motions.formats.archives import addresses
from mimic.motions.formats.cells import joined_cells, read_cells
from mimic.motions.formats.episodes import ANGLE, GRIPPER, VELOCITY, Motion
from mimic.motions.formats.replacing import Column, Replacement, replaced_columns
from mimic.motions.formats.tables import rows_of_table, tables_by_quantity

_DIGITS = ".9g"  # of a number in a table
_BLANK = "\t"  # between cells that blanks separated


def rewrite_table(source: Path, out: Path, replacement: Replacement, timed: bool) -> list[str]:
    """Writes the table into a folder, under its name.

    Args:
      source: the table.
      out: the folder.
      replacement: what stands in place of the joints.
      timed: whether the table has times.

    Returns:
      The names of columns that are left out, see `replaced_columns`.
    """
    ((entry, old_joints),) = replacement.old_joints.items()
    motions = replacement.motions[entry]
    text, names, episodes = rows_of_table(source, len(old_joints), timed)
    _, gripper = replacement.grippers.get(entry, ("", ()))
    columns, dropped = replaced_columns(names, old_joints, replacement.joints, gripper)
    separator = text.separator or _BLANK
    decimal = "," if separator != "," and "," in "".join(text.rows[:1]) else "."
    lines = [*text.comments, *([joined_cells([column.name for column in columns], separator)] if text.header else [])]
    count = dict.fromkeys(episodes, 0)
    for row, episode in zip(text.rows, episodes, strict=True):
        if episode in replacement.kept:
            cells, motion, at = text.cells(row), motions[episode], count[episode]
            lines.append(joined_cells([_cell(cells, column, motion, at, decimal) for column in columns], separator))
        count[episode] += 1
    _write(out / source.name, lines)
    return dropped


def _cell(cells: Sequence[str], column: Column, motion: Motion, at: int, decimal: str) -> str:
    """The text of a cell: the old one, or the number of the learner's joint at a sample."""
    if column.quantity is None:
        return cells[column.index]
    values = {ANGLE: motion.qpos, VELOCITY: motion.qvel, GRIPPER: motion.gripper}[column.quantity]
    return f"{values[at, column.joint]:{_DIGITS}}".replace(".", decimal)  # type: ignore[index]  # see `Replacement`


def rewrite_folder_of_tables(source: Path, out: Path, replacement: Replacement) -> list[str]:
    """Writes a folder with a table for each quantity; returns the names of tables that are left out."""
    ((motion,),) = (motions.values() for motions in replacement.motions.values())
    values = {ANGLE: motion.qpos, VELOCITY: motion.qvel}
    dropped = []
    for quantity, path in tables_by_quantity(source).items():
        if quantity == "time":
            _write(out / path.name, read_cells(path).rows)
        elif (rows := values.get(quantity)) is not None:  # type: ignore[call-overload]
            _write(out / path.name, [_BLANK.join(f"{number:{_DIGITS}}" for number in row) for row in rows])
        else:
            dropped.append(path.name)
    return dropped


def rewrite_archive(source: Path, out: Path, replacement: Replacement) -> list[str]:
    """Writes an npz file in LocoMuJoCo's format into a folder, under its name; other joints and arrays stay."""
    ((entry, old_joints),) = replacement.old_joints.items()
    motions, content = replacement.motions[entry], dict(read_arrays(source, None))
    names, kinds = list(map(str, np.atleast_1d(content["joint_names"]))), content.get("jnt_type")
    angle_at, velocity_at = addresses(kinds, names)
    place, others = names.index(old_joints[0]), [i for i, name in enumerate(names) if name not in old_joints]
    before, after = ([i for i in others if (i < place) == is_before] for is_before in (True, False))
    rows, samples = _rows(content, replacement.kept), len(content["qpos"])
    for key, array in content.items():
        if array.ndim and len(array) == samples and key not in ("joint_names", "jnt_type", "split_points"):
            content[key] = array[rows]
    kept = [motions[episode] for episode in replacement.kept]
    for channel, name in enumerate(replacement.grippers.get(entry, ("", ()))[1]):
        opening = np.concatenate([motion.gripper[:, channel] for motion in kept])  # type: ignore[index]
        content["qpos"][:, angle_at[names.index(name)]] = opening
    for key, at, of in (
        ("qpos", angle_at, lambda motion: motion.qpos),
        ("qvel", velocity_at, lambda motion: motion.qvel),
    ):
        if key in content:
            old = content[key]
            parts = [[old[:, at[i] : at[i + 1]] for i in indices] for indices in (before, after)]
            new = np.concatenate([of(motion) for motion in kept]).astype(old.dtype)
            content[key] = np.concatenate([*parts[0], new, *parts[1]], axis=1)
    content["joint_names"] = np.array([*(names[i] for i in before), *replacement.joints, *(names[i] for i in after)])
    if kinds is not None:
        learner = np.full(len(replacement.joints), kinds[place], kinds.dtype)
        content["jnt_type"] = np.concatenate([kinds[before], learner, kinds[after]])
    if "split_points" in content:
        content["split_points"] = np.cumsum([0, *(len(motion.time) for motion in kept)])
    with open(out / source.name, "wb") as file:
        np.savez_compressed(file, **content)  # pyright: ignore[reportArgumentType]
    return []


def _rows(content: Mapping[str, Any], kept: Sequence[str]) -> np.ndarray:
    """The samples of the kept motions in the arrays of all, whose names end in their numbers; see `read_archive`."""
    points = np.atleast_1d(content.get("split_points", (0, len(content["qpos"])))).astype(int)
    numbers = [int(episode.split()[-1]) for episode in kept]
    return np.concatenate([np.arange(points[number], points[number + 1]) for number in numbers])


def _write(path: Path, lines: Sequence[str]) -> None:
    content = ("\n".join(lines) + "\n").encode()
    path.write_bytes(gzip.compress(content, mtime=0) if path.suffix.lower() == ".gz" else content)
