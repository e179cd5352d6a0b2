"""Differences between two results files of one benchmark that exceed their spread.

    python -m benchmarks.compare OLD NEW [--minimum 0.05]

A value counts as changed if it differs by more than the spreads of both files together, and by more than a minimum
relative change. The spread is that of the times in the file, or the standard deviation over seeds.
"""

import json
import math
import statistics
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.common.parser import BenchmarkParser
from benchmarks.common.record import print_table

# Numbers that identify a row, together with all text in it; the other numbers are compared.
_NAMES = ("size", "arms", "links", "batch", "joints", "devices", "processes", "substeps", "horizon", "starts", "count")
_CONDITIONS = ("hardware", "versions", "date", "commit", "note", "arguments")
_TIMED = ("median_s", "median_ms", "steps_per_s", "pairs_per_s", "poses_per_s")  # which the spread of a row is of


class Value(NamedTuple):
    """A number over the seeds: mean, and spread in the same unit (0 if unknown)."""

    mean: float
    spread: float

    def __str__(self) -> str:
        return f"{self.mean:.4g}" + (f" ± {self.spread:.2g}" if self.spread else "")


def read_values(results: dict[str, Any]) -> dict[str, Value]:
    """All values of a file by their paths: names of cases and entries, separated by ` / `."""
    entries = defaultdict(list)
    for path, value, spread in _walk(results, ()):
        entries[" / ".join(path)].append((value, spread))
    merged = {}
    for path, measured in entries.items():
        numbers = [value for value, _ in measured]
        over_seeds = statistics.stdev(numbers) if len(numbers) > 1 else 0.0
        merged[path] = Value(statistics.fmean(numbers), max(over_seeds, *(spread for _, spread in measured)))
    return merged


def _walk(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], float, float]]:
    """Numbers with their paths and spreads."""
    if isinstance(value, dict):
        relative = value.get("spread", 0.0)
        for key, entry in value.items():
            if key in (*_CONDITIONS, *_NAMES, "seed", "spread"):
                continue
            if isinstance(entry, int | float) and not isinstance(entry, bool) and math.isfinite(entry):
                yield (*path, key), entry, relative * abs(entry) if key in _TIMED else 0.0
            else:
                yield from _walk(entry, (*path, key))
    elif isinstance(value, list):
        for row in value:
            if isinstance(row, dict):  # lists of numbers, as curves, are not compared
                texts = [text for text in row.values() if isinstance(text, str)]
                yield from _walk(row, (*path, *texts, *(f"{key}={row[key]}" for key in _NAMES if key in row)))


def changed(old: dict[str, Value], new: dict[str, Value], minimum: float) -> list[tuple[str, Value, Value]]:
    """Values of both files that differ by more than their spreads and the minimum relative change."""
    pairs = ((path, old[path], new[path]) for path in sorted(old.keys() & new.keys()))
    return [
        (path, before, after)
        for path, before, after in pairs
        if abs(after.mean - before.mean) > max(before.spread + after.spread, minimum * abs(before.mean))
    ]


def _read(path: Path) -> dict[str, Any]:
    try:
        results = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise SystemExit(f"error: {path}: expected a results file, got {error}") from None
    if not isinstance(results, dict) or "benchmark" not in results:
        raise SystemExit(f"error: {path}: expected a results file, which names its benchmark")
    return results


def main() -> None:
    parser = BenchmarkParser("compare", __doc__, out="")
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--minimum", type=float, default=0.05, metavar="RATIO", help="minimum relative change (0.05)")
    options = parser.parse_args()
    files = {"old": _read(options.old), "new": _read(options.new)}
    names = [file["benchmark"] for file in files.values()]
    if len(set(names)) > 1:
        raise SystemExit(f"error: expected files of one benchmark, got {' and '.join(names)}")
    for name, file in files.items():
        print(f"{name}: {file.get('date')}, commit {file.get('commit')}, {file.get('hardware', {}).get('device')}")
    old, new = (read_values(file) for file in files.values())
    rows = [
        {"value": path, "old": before, "new": after, "change": before.mean and after.mean / before.mean - 1}
        for path, before, after in changed(old, new, options.minimum)
    ]
    if rows:
        print_table(rows, {"value": "{value}", "old": "{old!s}", "new": "{new!s}", "change": "{change:+.1%}"})
    print(f"{len(rows)} of {len(old.keys() & new.keys())} values changed")
    for name, missing in (("new", old.keys() - new.keys()), ("old", new.keys() - old.keys())):
        if missing:
            print(f"{len(missing)} values are not in the {name} file, as {min(missing)}")


if __name__ == "__main__":
    main()
