"""What all benchmarks share: a training run as a process of its own, and files of results that can be trusted."""

import csv
import datetime
import importlib.metadata
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mimic.runs.files import METRICS
from mimic.runs.provenance import hardware, versions

_HELD = 3  # evaluations on end


def write_results(out: Path, benchmark: str, commit: str | None, **content: Any) -> None:
    """Replaces a file of results, with what they were made on, only when the new one is whole."""
    results = {
        "benchmark": benchmark,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes"),
        "commit": commit or commit_id(),
        "hardware": hardware(),
        "versions": {**versions(), "mink": importlib.metadata.version("mink")},
        **content,
    }
    partial = out.with_name(out.name + ".partial")
    partial.write_text(json.dumps(results, indent=2) + "\n")
    os.replace(partial, out)


def time_to_goal(run_dir: Path, quality: str, goal: float) -> float | None:
    """Time [s] since the process started from which a quality is at most the goal, for three evaluations on end.

    For all that are left, if the training ends before; None where it never is.
    """
    with (run_dir / METRICS).open(newline="") as file:
        rows = [(float(row[f"quality/{quality}"]), float(row["wall_time_s"])) for row in csv.DictReader(file)]
    reached = (wall for i, (_, wall) in enumerate(rows) if all(value <= goal for value, _ in rows[i : i + _HELD]))
    return next(reached, None)


def commit_id() -> str:
    """What is checked out, where this is a git checkout."""
    found = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    return found.stdout.strip() if found.returncode == 0 else "unknown"


def train(
    run_dir: Path,
    arguments: Sequence[str],
    cache: Path | None = None,
    environment: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """One training run into a new folder: its report, and the wall time of the whole process [s].

    Args:
      run_dir: the new folder.
      arguments: of `python -m mimic.train`.
      cache: where compiled programs are kept; the run is cold where None, or where the folder is empty.
      environment: variables of the process; this one's where None.
    """
    command = [sys.executable, "-m", "mimic.train", *arguments, f"run_dir={run_dir}"]
    command.append(f"compilation_cache={cache or ''}")
    began = time.perf_counter()
    finished = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    wall = time.perf_counter() - began
    if finished.returncode:
        sys.exit(f"error: {' '.join(command)} ended with {finished.returncode}: {finished.stderr[-2000:]}")
    report = json.loads((run_dir / "report.json").read_text())
    report = {key: value for key, value in report.items() if key not in ("hardware", "versions")}
    return {"arguments": list(arguments), "process_wall_s": round(wall, 1), "report": report}
