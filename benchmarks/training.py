"""Trains as a user does, each run a process of its own: how good, how fast, and how long until it is good.

    python -m benchmarks.training --out FILE [--case NAME ...] [--seeds 0 1] [--cold]

Each run is made twice: cold, with nothing compiled before, and warm, with what the first has compiled; or cold alone.
"To the goal" is the time from the start of the process until the gap on the training demonstrations is at the case's
goal for the first of three evaluations on end (of all that are left, if the training ends before). The file holds each
run's report.
"""

import argparse
import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.table import Table

from benchmarks.record import time_to_goal, train, write_results


@dataclasses.dataclass(frozen=True)
class Case:
    """A training run.

    Attributes:
      arguments: of `python -m mimic.train`.
      goal: optimality gap that counts as good.
      on: arguments besides, by backend.
    """

    arguments: tuple[str, ...]
    goal: float
    on: dict[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)


CASES = {
    "one_demonstration": Case(
        ("env=panda7dof", "env.physics=fused", "env.demonstrations.count=1"),
        0.02,
        {
            "gpu": ("trainer.num_timesteps=15000000", "trainer.evaluations=15"),
            "cpu": ("trainer.num_timesteps=800000", "trainer.evaluations=8"),
        },
    ),
    "panda7dof": Case(("env=panda7dof", "env.physics=fused"), 0.02),
    "panda4dof": Case(("env=panda4dof", "env.physics=fused"), 0.03),
    "panda3dof": Case(("env=panda3dof", "env.physics=fused"), 0.03),
}


def run_case(name: str, seed: int, starts: Sequence[str] = ("cold", "warm")) -> list[dict[str, Any]]:
    """The run, from each start."""
    case = CASES[name]
    arguments = (*case.arguments, *case.on.get(jax.default_backend(), ()), f"seed={seed}")
    results = []
    with tempfile.TemporaryDirectory() as folder:
        for start in starts:
            run_dir = Path(folder) / start
            result = train(run_dir, arguments, cache=Path(folder) / "cache")
            to_goal = time_to_goal(run_dir, "optimality_gap.train", case.goal)
            results.append({"case": name, "start": start, "goal": case.goal, "to_goal_s": to_goal, **result})
    return results


def table(results: Sequence[dict[str, Any]]) -> Table:
    """A row for each run; wall times in seconds."""
    stages = ("import", "build", "compile", "train", "evaluate")
    shown = Table("case", "start", "seed", "gap", "held out", "to goal", "process", *stages, "steps/s")
    for result in results:
        report = result["report"]
        gap, wall = report["optimality_gap"], report["wall_time_s"]
        to_goal = result["to_goal_s"]
        shown.add_row(
            result["case"],
            result["start"],
            str(report["seed"]),
            f"{gap['train']:.2%}",
            f"{gap['held_out']:.2%}",
            "-" if to_goal is None else f"{to_goal:.1f}",
            f"{result['process_wall_s']:.1f}",
            *(f"{wall[stage]:.1f}" for stage in stages),
            f"{report['steps_per_second']:,.0f}",
        )
    return shown


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.training", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, metavar="FILE", help="file of results; printed only where none is given")
    parser.add_argument("--case", choices=CASES, nargs="+", default=list(CASES), metavar="NAME", help=", ".join(CASES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N")
    parser.add_argument("--cold", action="store_true", help="no run with what was compiled before")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    return parser.parse_args()


def main() -> None:
    """Runs the cases, and writes the file after each of them."""
    options = _arguments()
    results: list[dict[str, Any]] = []
    for name in options.case:
        for seed in options.seeds:
            results += run_case(name, seed, ("cold",) if options.cold else ("cold", "warm"))
            if options.out:
                write_results(options.out, "training", options.commit, runs=results)
    Console().print(table(results))


if __name__ == "__main__":
    main()
