"""Trains as a user does, each run a process of its own, and keeps the reports with what they were made on.

    python -m benchmarks.training --out FILE [--case NAME] [--seeds 0 1]

Prints a table; the file holds each run's report and the wall time from the start of the process to its end. Runs start
cold: without a compilation cache.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.record import train, write_results

CASES = {
    "panda4dof": ["env=panda4dof", "env.physics=fused"],
    "panda7dof_single": [
        "env=panda7dof",
        "env.physics=fused",
        "env.demonstrations.count=1",
        "trainer.target_gap=0.02",
    ],
}


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
            with tempfile.TemporaryDirectory() as folder:
                results.append({"case": name, **train(Path(folder) / "run", [*CASES[name], f"seed={seed}"])})
            if options.out:
                write_results(options.out, "training", options.commit, runs=results)
    Console().print(_table(results))


if __name__ == "__main__":
    main()
