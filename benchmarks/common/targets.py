"""Targets of mimic, which are in targets.yaml, and the values of the results files in a folder."""

import dataclasses
import json
import math
import operator
import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from benchmarks.common.record import Row

_RELATIONS = {">=": operator.ge, "<=": operator.le}
_REDUCTIONS = {"max": max, "min": min, "median": statistics.median, "mean": statistics.fmean}


@dataclasses.dataclass(frozen=True)
class Target:
    """A quantity and the value to reach; the fields are explained in targets.yaml."""

    quantity: str
    benchmark: str
    target: str
    entry: str
    where: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    minus: Mapping[str, Any] | None = None
    reduce: str = "max"
    backend: str = ""

    def met(self, value: float) -> bool:
        relation, target = self.target.split()[:2]
        return _RELATIONS[relation](value, float(target))

    def value(self, results: Mapping[str, Any]) -> float:
        """The value in a results file.

        Raises:
          LookupError, TypeError, ValueError: the file does not contain it.
        """
        value, *subtracted = (
            _REDUCTIONS[self.reduce](list(_entries(results, self.entry.split("."), where)))
            for where in (self.where, self.minus)
            if where is not None
        )
        return float(value - sum(subtracted))


def _entries(value: Any, path: Sequence[str], where: Mapping[str, Any]) -> Iterator[float]:
    if isinstance(value, list):
        for row in value:
            if "failed" not in row and all(row.get(key, wanted) == wanted for key, wanted in where.items()):
                yield from _entries(row, path, where)
    elif path:
        yield from _entries(value[path[0]], path[1:], where)
    else:
        yield math.inf if value is None else value


TARGETS = [Target(**fields) for fields in yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())]


def read_folder(folder: Path) -> dict[Path, Row]:
    """The results files of a folder, the newest last; other files are ignored."""
    files = {}
    for path in folder.glob("*.json"):
        try:
            results = json.loads(path.read_text())
        except ValueError:
            continue
        if isinstance(results, dict) and "benchmark" in results:
            files[path] = results
    return dict(sorted(files.items(), key=lambda file: (file[1].get("date", ""), file[0])))


def find(target: Target, files: Mapping[Path, Row]) -> tuple[float, Path] | None:
    """The value in the newest file that contains it, and that file."""
    for path, results in reversed(list(files.items())):
        backend = results.get("hardware", {}).get("backend")
        if results["benchmark"] == target.benchmark and target.backend in ("", backend):
            try:
                return target.value(results), path
            except (LookupError, TypeError, ValueError):  # another case of the benchmark, or null
                continue
    return None


def table(files: Mapping[Path, Row]) -> list[Row]:
    """A row for each target with the file of its value, or with the command that measures it."""
    rows = []
    for target in TARGETS:
        row = {"quantity": target.quantity, "on": target.backend or "any", "target": target.target}
        if known := find(target, files):
            value, path = known
            row |= {"measured": f"{value:,.4g}", "met": "met" if target.met(value) else "missed", "from": path.name}
        rows.append({"from": f"python -m benchmarks.run {target.benchmark}", **row})
    return rows
