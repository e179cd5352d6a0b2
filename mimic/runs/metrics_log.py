"""The metrics log of a training: CSV and TensorBoard events."""

import contextlib
import csv
import math
import os
import socket
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from mimic.base.files import read_text
from mimic.runs.files import METRICS, write_csv


class MetricsLog:
    """Metrics over training, as one CSV file and as TensorBoard events.

    Args:
      run_dir: the run directory.
      first_step: training steps of the first row that a resumed run writes; rows from there on are removed, and rows
        that were not written to their end.
    """

    def __init__(self, run_dir: Path, first_step: int | None = None):
        self._path = run_dir / METRICS
        self._tensorboard = _import_tensorboard()
        name = f"events.out.tfevents.{time.time():.0f}.{socket.gethostname()}"
        (run_dir / "tensorboard").mkdir(exist_ok=True)
        # Not by its SummaryWriter, whose thread prints the error of a full disk and goes on without writing.
        self._records = self._tensorboard.record_writer.RecordWriter(str(run_dir / "tensorboard" / name))
        self._write_event(file_version="brain.Event:2")
        if first_step is not None:
            log = self._tensorboard.proto.event_pb2.SessionLog
            self._write_event(step=first_step, session_log=log(status=log.START))
        self._columns, rows = _read(self._path)
        if first_step is not None and self._columns:
            self._rewrite([row for row in rows if row["step"].isdigit() and int(row["step"]) < first_step])

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Appends one row; columns without a metric are empty.

        Raises:
          OSError: it cannot be written; the file is as before.
        """
        row = {"step": step, **metrics}
        missing = [name for name in row if name not in self._columns]
        if missing:  # all for a new run, some if another version of mimic started the run
            _, rows = _read(self._path)
            self._columns += missing
            self._rewrite(rows)
        size = self._path.stat().st_size
        try:
            with self._path.open("a", newline="") as file:
                csv.DictWriter(file, self._columns).writerow(row)
        except OSError:
            os.truncate(self._path, size)
            raise
        for name, value in metrics.items():
            if math.isfinite(value):  # what is not has no place in a plot, and tensorboardX prints a line
                self._write_event(step=step, summary=self._tensorboard.summary.scalar(name, value))
        self._records.flush()

    def _write_event(self, **content: Any) -> None:
        event = self._tensorboard.proto.event_pb2.Event(wall_time=time.time(), **content)
        self._records.write(event.SerializeToString())

    def _rewrite(self, rows: list[dict[str, str]]) -> None:
        write_csv(self._path, self._columns, ([row.get(name, "") for name in self._columns] for row in rows))

    def close(self) -> None:
        """Closes the file of events; what could not be written is dropped."""
        with contextlib.suppress(OSError):
            self._records.close()


def _import_tensorboard() -> Any:
    """tensorboardX: half a second, and without the four of PyTorch, which it imports wherever that is installed."""
    with contextlib.ExitStack() as stack:
        if "torch" not in sys.modules:
            sys.modules["torch"] = cast(ModuleType, None)  # an ImportError, which tensorboardX expects
            stack.callback(sys.modules.pop, "torch")
        import tensorboardX

        return tensorboardX


def _read(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a metrics file, without rows that were not written to their end."""
    if not path.exists():
        return [], []
    lines = read_text(path, errors="replace").split("\n")[:-1]
    header, *rows = csv.reader(lines) if lines else [[]]
    complete = [row for row in rows if len(row) == len(header)]
    return header, [dict(zip(header, row, strict=True)) for row in complete]
