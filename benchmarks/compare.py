"""What moved between two files of results of one benchmark, beyond their spread.

    python -m benchmarks.compare OLD NEW [--least 0.05]

A figure moved if it changed by more than the spreads of both files together, and by more than the least change that is
asked for. The spread is what the file says of a time, or the standard deviation over seeds.
"""

import argparse
import json
import math
import statistics
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

# Numbers that say which row it is, besides all text in it; everything else is a figure.
_NAMES = ("size", "arms", "links", "batch", "joints", "devices", "processes", "substeps", "horizon", "starts", "count")
_MADE_ON = ("hardware", "versions", "date", "commit", "note", "arguments")
# Times and rates of one measurement share its spread.
_TIMED = ("median_s", "median_ms", "steps_per_s", "pairs_per_s", "poses_per_s")


class Figure(NamedTuple):
    """A number over the seeds: mean, and spread in the same unit (0 where unknown)."""

    mean: float
    spread: float


def figures(results: dict[str, Any]) -> dict[str, Figure]:
    """All figures of a file by where they are: names of cases and fields, with ` / ` between them."""
    found = defaultdict(list)
    for path, value, spread in _walk({key: value for key, value in results.items() if key not in _MADE_ON}, ()):
        found[" / ".join(path)].append((value, spread))
    merged = {}
    for path, entries in found.items():
        values = [value for value, _ in entries]
        seeds = statistics.stdev(values) if len(values) > 1 else 0.0
        merged[path] = Figure(statistics.fmean(values), max(seeds, *(spread for _, spread in entries)))
    return merged


def _walk(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], float, float]]:
    """Numbers with their paths and spreads."""
    if isinstance(value, dict):
        relative = value.get("spread", 0.0)
        for key, entry in value.items():
            if key in _MADE_ON or key in (*_NAMES, "seed", "spread"):
                continue
            if isinstance(entry, int | float) and not isinstance(entry, bool) and math.isfinite(entry):
                yield (*path, key), entry, relative * abs(entry) if key in _TIMED else 0.0
            else:
                yield from _walk(entry, (*path, key))
    elif isinstance(value, list):
        for entry in value:
            if isinstance(entry, dict):  # curves and other lists of numbers are no figures
                yield from _walk(entry, (*path, *_names(entry)))


def _names(row: dict[str, Any]) -> list[str]:
    named = [value for value in row.values() if isinstance(value, str)]
    return [*named, *(f"{key}={row[key]}" for key in _NAMES if key in row)]


def moved(old: dict[str, Figure], new: dict[str, Figure], least: float) -> list[tuple[str, Figure, Figure]]:
    """Figures of both files that differ by more than their spreads and the least relative change."""
    rows = []
    for path in old.keys() & new.keys():
        before, after = old[path], new[path]
        change = abs(after.mean - before.mean)
        if change > before.spread + after.spread and change > least * abs(before.mean):
            rows.append((path, before, after))
    return sorted(rows)


def _read(path: Path) -> dict[str, Any]:
    try:
        results = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise SystemExit(f"error: {path}: expected a file of results, got {error}") from None
    if not isinstance(results, dict) or "benchmark" not in results:
        raise SystemExit(f"error: {path}: expected a file of results, which names its benchmark")
    return results


def main() -> None:
    """Compares, and says what is in one file alone."""
    summary = (__doc__ or "").split("\n")[0]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compare", description=summary)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--least", type=float, default=0.05, metavar="SHARE", help="least relative change (0.05)")
    options = parser.parse_args()
    old_file, new_file = _read(options.old), _read(options.new)
    if old_file["benchmark"] != new_file["benchmark"]:
        raise SystemExit(f"error: expected one benchmark, got {old_file['benchmark']} and {new_file['benchmark']}")
    console = Console()
    for name, file in (("old", old_file), ("new", new_file)):
        hardware = file.get("hardware", {})
        console.print(
            f"{name}: {file.get('date')}, commit {file.get('commit')}, {hardware.get('device')}", highlight=False
        )
    old, new = figures(old_file), figures(new_file)
    rows = moved(old, new, options.least)
    table = Table("figure", "old", "new", "change")
    for path, before, after in rows:
        change = f"{after.mean / before.mean - 1:+.1%}" if before.mean else ""
        table.add_row(path, _text(before), _text(after), change)
    if rows:
        console.print(table)
    console.print(f"{len(rows)} of {len(old.keys() & new.keys())} figures moved", highlight=False)
    for name, missing in (("new", old.keys() - new.keys()), ("old", new.keys() - old.keys())):
        if missing:
            console.print(f"{len(missing)} figures are not in the {name} file, as {min(missing)}", highlight=False)


def _text(figure: Figure) -> str:
    return f"{figure.mean:.4g}" + (f" ± {figure.spread:.2g}" if figure.spread else "")


if __name__ == "__main__":
    main()
