"""Results of a benchmark: written to a file with what they were measured on, and printed as tables."""

import argparse
import datetime
import importlib.metadata
import json
import subprocess
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks.common import measured_code
from mimic.base.files import write_atomically
from mimic.runs.files import finite
from mimic.runs.provenance import hardware, versions

WIDTH = 140  # characters of a table, also without a terminal
Row = dict[str, Any]


def write_results(options: argparse.Namespace, **content: Any) -> None:
    """Replaces the file of `--out`, if any, by this content with date, commit, code, hardware and versions."""
    if options.out is None:
        return
    process = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    results = {
        "benchmark": options.benchmark,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes"),
        "commit": options.commit or process.stdout.strip() or "unknown",
        "code": measured_code.hashes(options.benchmark),
        "hardware": hardware(),
        "versions": {**versions(), "mink": importlib.metadata.version("mink")},
        **content,
    }
    write_atomically(options.out, json.dumps(finite(results), indent=2) + "\n")


def collect(options: argparse.Namespace, rows: Iterable[Row], key: str, columns: str, **content: Any) -> list[Row]:
    """Rewrites the results file after each row: rows under a key, and other content. Prints the table of all rows."""
    measured: list[Row] = []
    for row in rows:
        measured.append(row)
        write_results(options, **content, **{key: measured})
    print_table(measured, columns)
    return measured


def failure(error: Exception) -> Row:
    return {"failed": f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"[:200]}


def print_table(rows: Iterable[Mapping[str, Any]], columns: str, title: str | None = None) -> None:
    """Prints entries of rows in formats as "case steps_per_s:,.0f gap[train]:.2%"; or the reason, if a row failed."""
    table = Table(*(escape(column.partition(":")[0]) for column in columns.split()), title=title)
    for row in rows:
        cells = [_cell(column, row) for column in columns.split()]
        table.add_row(*([*cells[:-1], row["failed"]] if "failed" in row else cells))
    Console(width=WIDTH).print(table)


def _cell(column: str, row: Mapping[str, Any]) -> str:
    try:
        return f"{{{column}}}".format_map(row)
    except (LookupError, TypeError, ValueError):  # no such entry, or None
        return "-"
