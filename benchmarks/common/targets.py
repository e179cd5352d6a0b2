"""Targets of mimic, which are in targets.yaml, and the values of the results files in a folder."""

import dataclasses
import json
import math
import operator
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
        """The value in a results file; a `LookupError`, `TypeError` or `ValueError` if it is not there."""
        value, *subtracted = (
            _REDUCTIONS[self.reduce](list(_entries(results, self.entry.split("."), where)))
            for where in (self.where, self.minus)
            if where is not None
        )
        return float(value - sum(subtracted))


def _entries(value: Any, path: Sequence[str], where: Mapping[str, Any]) -> Iterator[float]:
    if isinstance(value, list):
        for row in value:
            if "failed" not in row and all(row.get(key, chosen) == chosen for key, chosen in where.items()):
                yield from _entries(row, path, where)
    elif path:
        yield from _entries(value[path[0]], path[1:], where)
    else:
        yield math.inf if value is None else value


TARGETS = [Target(**fields) for fields in yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())]


def read_folder(folder: Path) -> list[tuple[str, Row]]:
    """Names and contents of the results files of a folder, the newest first; other files are ignored."""
    files = []
    for path in folder.glob("*.json"):
        try:
            files.append((path.name, json.loads(path.read_text())))
        except ValueError:
            continue
    results = [file for file in files if isinstance(file[1], dict) and "benchmark" in file[1]]
    return sorted(results, key=lambda file: (file[1].get("date", ""), file[0]), reverse=True)


def find(target: Target, files: Iterable[tuple[str, Row]]) -> tuple[float, str] | None:
    """The value of the newest file that has one, and the name of that file."""
    for name, results in files:
        backend = results.get("hardware", {}).get("backend")
        if results["benchmark"] == target.benchmark and target.backend in ("", backend):
            try:
                return target.value(results), name
            except (LookupError, TypeError, ValueError):  # another case of the benchmark, or null
                continue
    return None


def table(files: Sequence[tuple[str, Row]]) -> Iterator[Row]:
    """A row for each target with the file of its value, or with the command that measures it."""
    for target in TARGETS:
        row = {"quantity": target.quantity, "on": target.backend or "any", "target": target.target}
        value, name = find(target, files) or (math.nan, f"python -m benchmarks.run {target.benchmark}")
        met = "" if math.isnan(value) else "met" if target.met(value) else "missed"
        yield {**row, "measured": value, "met": met, "from": name}
