"""Trains as a user does, each run a process of its own, and keeps the reports with what they were made on.

    python -m benchmarks.training --out FILE [--case NAME] [--seeds 0 1]

Prints a table; the file holds each run's report and the wall time from the start of the process to its end. Runs start
cold: without a compilation cache.
"""

import argparse
import datetime
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

CASES = {
    "panda4dof": ["env=panda4dof"],
    "panda7dof_single": [
        "env=panda7dof",
        "env.demonstrations.count=1",
        "trainer.target_gap=0.02",
    ],
}


def run_once(arguments: Sequence[str]) -> dict[str, Any]:
    """One training run: its report, and the wall time of the whole process [s]."""
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        command = [sys.executable, "-m", "mimic.train", *arguments, f"run_dir={run_dir}", "compilation_cache="]
        began = time.perf_counter()
        finished = subprocess.run(command, capture_output=True, text=True, check=False)
        wall = time.perf_counter() - began
        if finished.returncode:
            sys.exit(f"error: {' '.join(command)} ended with {finished.returncode}: {finished.stderr[-2000:]}")
        report = json.loads((run_dir / "report.json").read_text())
    return {"arguments": list(arguments), "process_wall_s": round(wall, 1), "report": report}


def write(out: Path, results: Sequence[dict[str, Any]], commit: str) -> None:
    """Replaces the file of results, only when the new one is whole."""
    content = {
        "benchmark": "training",
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "commit": commit,
        "hardware": results[0]["report"]["hardware"],
        "versions": results[0]["report"]["versions"],
        "runs": [{**result, "report": _without_machine(result["report"])} for result in results],
    }
    partial = out.with_name(out.name + ".partial")
    partial.write_text(json.dumps(content, indent=2) + "\n")
    os.replace(partial, out)


def _without_machine(report: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in report.items() if key not in ("hardware", "versions")}


def _table(results: Sequence[dict[str, Any]]) -> Table:
    table = Table("case", "seed", "gap, training", "gap, held out", "process [s]", "compile [s]", "steps/s")
    for result in results:
        report = result["report"]
        gap = report["optimality_gap"]
        table.add_row(
            result["case"],
            str(report["seed"]),
            f"{gap['train']:.2%}",
            f"{gap['held_out']:.2%}",
            f"{result['process_wall_s']:.1f}",
            f"{report['wall_time_s']['compile']:.1f}",
            f"{report['steps_per_second']:,.0f}",
        )
    return table


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.training", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, help="file of results; printed only where none is given")
    parser.add_argument(
        "--case", choices=CASES, action="append", help="run this case (may be repeated); all by default"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    return parser.parse_args()


def main() -> None:
    """Runs the cases, and writes the file after each run."""
    options = _arguments()
    results: list[dict[str, Any]] = []
    for name in options.case or CASES:
        for seed in options.seeds:
            results.append({"case": name, **run_once([*CASES[name], f"seed={seed}"])})
            if options.out:
                write(options.out, results, options.commit or commit_id())
    Console().print(_table(results))


def commit_id() -> str:
    """What is checked out, where this is a git checkout."""
    found = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    return found.stdout.strip() if found.returncode == 0 else "unknown"


if __name__ == "__main__":
    main()
