"""Reads the cells of tables of text."""

import csv
import gzip
import math
import zlib
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.base.files import MAX_BYTES, open_file, read_text
from mimic.motions.formats.names import UNSEEN


class Cells(NamedTuple):
    """The text of a table.

    Attributes:
      comments: lines of comments, without those of the header.
      header: names of columns; empty where there are none.
      rows: lines below the header.
      separator: between cells; None for blanks.
      table: [rows, columns] their numbers; NaN for empty cells and words.
    """

    comments: list[str]
    header: list[str]
    rows: list[str]
    separator: str | None
    table: Float[np.ndarray, "rows columns"]

    def cells(self, row: str) -> list[str]:
        """The texts of the cells in a row."""
        return split_cells(row, self.separator)


def read_cells(path: Path) -> Cells:
    """The text of a table, and its numbers.

    Raises:
      ValueError: it is no table of numbers below a header.
    """
    try:
        lines = [line for line in _text(path).splitlines() if line.strip(" ,;\t")]
        comments = [line for line in lines if line.lstrip().startswith(("#", "%"))]
        lines = [line for line in lines if not line.lstrip().startswith(("#", "%"))]
        if not lines:
            raise ValueError("it has no rows")
        separator = next((mark for mark in ";\t," if mark in lines[0]), None)
        header, rows = split_cells(lines[0], separator), lines[1:]
        if _are_numbers(header, separator):
            header, rows = split_cells(comments[-1].lstrip("#% "), separator) if comments else [], lines
            if _are_numbers(header, separator) or len(header) != len(split_cells(lines[0], separator)):
                header = []
            comments = comments[: len(comments) - bool(header)]
        table = _numbers(rows, separator)
        if header and rows and table.shape[1] != len(header):
            raise ValueError(f"its rows have {table.shape[1]} cells, its header {len(header)}")
        table = table.reshape(len(rows), len(header) or -1)
        return Cells(comments, header, rows, separator, table)
    except (OSError, EOFError, ValueError, csv.Error, zlib.error) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"source: {str(path)!r} is no table of numbers below a header: {reason}") from error


def _numbers(rows: list[str], separator: str | None) -> np.ndarray:
    """The numbers in rows; the faster way does not know empty cells, quotes, decimal commas, dates and words.

    Raises:
      ValueError: rows of other lengths, or a word among the numbers of a column.
    """
    try:
        return np.loadtxt(rows, delimiter=separator, comments=None, ndmin=2) if rows else np.zeros((0, 0))
    except ValueError:
        table = [split_cells(row, separator) for row in rows]
    for number, row in enumerate(table, start=1):
        if len(row) != len(table[0]):
            raise ValueError(f"row {number} has {len(row)} cells, expected {len(table[0])}")
    return np.stack([_column(cells, separator) for cells in zip(*table, strict=True)], axis=1)


def _column(cells: Sequence[str], separator: str | None) -> np.ndarray:
    """The numbers in a column: dates as seconds since 1970, and NaN for empty cells and where all are words."""
    values = [_number(cell, separator) for cell in cells]
    numbers = np.array([math.nan if value is None else value for value in values])
    if words := [cell for cell, value in zip(cells, values, strict=True) if value is None]:
        if len(words) + sum(cell.lower() in UNSEEN for cell in cells) < len(cells):
            raise ValueError(f"expected a number, got {words[0]!r:.40}")
        try:
            dates = [datetime.fromisoformat(word) for word in words]
        except ValueError:
            return numbers
        numbers[[value is None for value in values]] = [
            date.replace(tzinfo=date.tzinfo or UTC).timestamp() for date in dates
        ]
    return numbers


def _text(path: Path) -> str:
    if path.suffix.lower() != ".gz":
        return read_text(path)
    with open_file(path) as file, gzip.GzipFile(fileobj=file) as packed:
        content = packed.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise ValueError(f"expected at most {MAX_BYTES:,} bytes")
    return content.decode("utf-8-sig")


def split_cells(line: str, separator: str | None) -> list[str]:
    """The texts of the cells of a line; a separator within quotes separates none."""
    cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True)) if separator else line.split()
    return [cell.strip().strip('"').strip() for cell in cells]


def joined_cells(cells: Sequence[str], separator: str) -> str:
    """A line with these cells, as `split_cells` reads it."""
    return separator.join(f'"{cell}"' if separator in cell else cell for cell in cells)


def _number(cell: str, separator: str | None) -> float | None:
    """The number in a cell, NaN in one that says that there is none; None for another word."""
    if cell.lower() in UNSEEN:
        return math.nan
    try:
        return float(cell if separator == "," else cell.replace(",", "."))
    except ValueError:
        return None


def _are_numbers(cells: Sequence[str], separator: str | None) -> bool:
    return None not in [_number(cell, separator) for cell in cells]
