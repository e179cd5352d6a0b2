"""The metrics log of a training: CSV and TensorBoard events."""

import csv
from collections.abc import Mapping
from pathlib import Path

from mimic import compat
from mimic.runs.files import METRICS


class MetricsLog:
    """Metrics over training, as one CSV file and as TensorBoard events. A resumed run appends to them."""

    def __init__(self, run_dir: Path):
        self._path = run_dir / METRICS
        self._writer = compat.import_tensorboard().SummaryWriter(str(run_dir / "tensorboard"))
        self._columns: list[str] = []  # of the file, once it has been read or created

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Appends one row; columns without a metric are empty."""
        row = {"step": step, **metrics}
        if not set(row) <= set(self._columns):
            self._add_columns(row)
        with self._path.open("a", newline="") as file:
            csv.DictWriter(file, self._columns).writerow(row)
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)

    def _add_columns(self, row: Mapping[str, float]) -> None:
        """Adds missing columns to the file: all for a new run, some if another version of mimic started the run."""
        rows: list[dict[str, str]] = []
        if self._path.exists():
            with self._path.open(newline="") as file:
                reader = csv.DictReader(file)
                self._columns, rows = list(reader.fieldnames or ()), list(reader)
        missing = [name for name in row if name not in self._columns]
        if missing:
            self._columns += missing
            new = self._path.with_suffix(".new")
            with new.open("w", newline="") as file:
                writer = csv.DictWriter(file, self._columns)
                writer.writeheader()
                writer.writerows(rows)
            new.replace(self._path)

    def close(self) -> None:
        """Writes buffered events."""
        self._writer.close()
