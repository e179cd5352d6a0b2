"""Results of a benchmark: written to a file with what they were measured on, and printed as a table."""

import argparse
import datetime
import importlib.metadata
import json
import subprocess
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

from mimic.runs.files import finite, write_atomically
from mimic.runs.provenance import hardware, versions

WIDTH = 140  # characters of a table, also without a terminal
Row = dict[str, Any]


class Results:
    """The results file of a benchmark.

    Args:
      benchmark: its name.
      options: the parsed command line.

    Attributes:
      figure: path of the figure beside the file; None without a file.
    """

    def __init__(self, benchmark: str, options: argparse.Namespace):
        self._benchmark, self._out = benchmark, options.out
        self._commit = options.commit or commit_id()
        self.figure = options.out and options.out.with_suffix(".png")

    def write(self, **content: Any) -> None:
        """Replaces the file, if there is one, with this content, date, commit, hardware and versions."""
        if self._out is None:
            return
        results = {
            "benchmark": self._benchmark,
            "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes"),
            "commit": self._commit,
            "hardware": hardware(),
            "versions": {**versions(), "mink": importlib.metadata.version("mink")},
            **content,
        }
        write_atomically(self._out, json.dumps(finite(results), indent=2) + "\n")


def commit_id() -> str:
    """The commit that is checked out; "unknown" outside a git repository."""
    process = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    return process.stdout.strip() if process.returncode == 0 else "unknown"


def failure(error: Exception) -> Row:
    """Entry of a row for a measurement that failed."""
    return {"failed": f"{type(error).__name__}: {str(error).split(chr(10))[0]}"[:200]}


def print_table(rows: Iterable[Mapping[str, Any]], columns: Mapping[str, str], title: str | None = None) -> None:
    """Prints rows as a table.

    Args:
      rows: the results; the reason of a row that failed is shown in its last column.
      columns: format string of each column, filled in from the row, as in {"steps/s": "{steps_per_s:,.0f}"}.
      title: of the table.
    """
    table = Table(*columns, title=title)
    for row in rows:
        cells = [_cell(form, row) for form in columns.values()]
        table.add_row(*([*cells[:-1], row["failed"]] if "failed" in row else cells))
    Console(width=WIDTH).print(table)


def _cell(form: str, row: Mapping[str, Any]) -> str:
    try:
        return form.format_map(row)
    except (LookupError, TypeError, ValueError):  # no such value, or None
        return "-"
