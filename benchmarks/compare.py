"""Differences between two results files of one benchmark that exceed their spread.

    python -m benchmarks.compare OLD NEW [--minimum 0.05]

A value counts as changed if it differs by more than the spreads of both files together, and by more than a minimum
relative change. The spread is that of the times in the file, or the standard deviation over seeds.
"""

import json
import math
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.common.parser import make_parser
from benchmarks.common.record import print_table

# Numbers that identify a row, together with all text in it; the other numbers are compared.
_NAMES = ("size", "arms", "links", "batch", "joints", "devices", "processes", "substeps", "horizon", "starts", "count")
_IGNORED = (*_NAMES, "hardware", "versions", "date", "commit", "note", "arguments", "seed", "spread")
_TIMED = ("median_s", "median_ms", "steps_per_s", "pairs_per_s", "poses_per_s")  # numbers that a row's spread is of


class Value(NamedTuple):
    """A number over the seeds: mean, and spread in the same unit (0 if unknown)."""

    mean: float
    spread: float

    def __str__(self) -> str:
        return f"{self.mean:.4g}" + (f" ± {self.spread:.2g}" if self.spread else "")


def read_values(results: dict[str, Any]) -> dict[str, Value]:
    """All values of a file by their paths: names of cases and entries, separated by ` / `."""
    entries: dict[str, list[Value]] = {}
    for path, value in _walk(results, ()):
        entries.setdefault(" / ".join(path), []).append(value)
    for path, values in entries.items():
        means, spreads = zip(*values, strict=True)
        deviation = statistics.stdev(means) if len(means) > 1 else 0.0
        entries[path] = [Value(statistics.fmean(means), max(deviation, *spreads))]
    return {path: value for path, (value,) in entries.items()}


def _walk(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Value]]:
    if isinstance(value, dict):
        for key, entry in value.items():
            if key in _IGNORED:
                continue
            if isinstance(entry, int | float) and not isinstance(entry, bool) and math.isfinite(entry):
                yield (*path, key), Value(entry, value.get("spread", 0.0) * abs(entry) if key in _TIMED else 0.0)
            else:
                yield from _walk(entry, (*path, key))
    elif isinstance(value, list):
        for row in value:
            if isinstance(row, dict):  # lists of numbers, as curves, are not compared
                texts = [text for text in row.values() if isinstance(text, str)]
                yield from _walk(row, (*path, *texts, *(f"{key}={row[key]}" for key in _NAMES if key in row)))


def changed(before: Value, after: Value, minimum: float) -> bool:
    """Whether values differ by more than their spreads and the minimum relative change."""
    return abs(after.mean - before.mean) > max(before.spread + after.spread, minimum * abs(before.mean))


def _read(path: Path) -> dict[str, Any]:
    try:
        results = json.loads(path.read_text())
        print(f"{path}: {results['date']}, commit {results['commit']}, {results['hardware'].get('device')}")
        return results
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise SystemExit(f"error: {path}: expected a results file, got {error!r}") from None


def main() -> None:
    parser = make_parser("compare", __doc__, out="", minimum=0.05)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    options = parser.parse_args()
    files = _read(options.old), _read(options.new)
    names = {file["benchmark"] for file in files}
    if len(names) > 1:
        raise SystemExit(f"error: expected files of one benchmark, got {' and '.join(sorted(names))}")
    old, new = map(read_values, files)
    rows = []
    for path in sorted(old.keys() & new.keys()):
        before, after = old[path], new[path]
        if changed(before, after, options.minimum):
            change = after.mean / before.mean - 1 if before.mean else None
            rows.append({"value": path, "old": str(before), "new": str(after), "change": change})
    print_table(rows, "value old new change:+.1%")
    print(f"{len(rows)} of {len(old.keys() & new.keys())} values changed")
    for name, missing in (("new", old.keys() - new.keys()), ("old", new.keys() - old.keys())):
        if missing:
            print(f"{len(missing)} values are not in the {name} file, as {min(missing)}")


if __name__ == "__main__":
    main()
