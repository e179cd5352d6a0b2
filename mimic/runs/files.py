"""Files of a run directory: their names, and writing them atomically."""

import contextlib
import csv
import io
import json
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mimic.base.files import read_json, write_atomically

CONFIG, REPORT, METRICS, DEMONSTRATIONS = "config.yaml", "report.json", "metrics.csv", "demonstrations.npz"


@contextlib.contextmanager
def written_atomically(folder: Path) -> Iterator[Path]:
    """An empty folder to write into, next to a new one that it becomes at the end; removed where writing fails."""
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    partial.mkdir()
    try:
        yield partial
        os.replace(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_report(folder: Path, report: Mapping[str, Any], name: str = REPORT) -> None:
    """Writes a report as JSON; numbers that are not finite, as after a divergence, are null."""
    write_atomically(folder / name, json.dumps(finite(report), indent=2, allow_nan=False) + "\n")


def read_report(run_dir: Path) -> dict[str, Any]:
    """The content of report.json.

    Raises:
      ValueError: there is none, because the training has not ended, or it cannot be read.
    """
    try:
        return read_json(run_dir / REPORT)
    except (OSError, ValueError) as error:
        raise ValueError(f"{str(run_dir / REPORT)!r} cannot be read: {error}") from error


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Writes a table."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(header)
    writer.writerows(rows)
    write_atomically(path, text.getvalue())


def reported_steps(run_dir: Path, unit: str) -> int:
    """Training steps of the parameters in a run's report; -1 without a report."""
    try:
        return int(read_report(run_dir)[unit])
    except (ValueError, LookupError, TypeError):
        return -1


def finite(value: Any) -> Any:
    """The same with None for floats that JSON cannot hold."""
    if isinstance(value, Mapping):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
