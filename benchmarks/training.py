"""Training runs as a user starts them: quality, speed, and time until a stated gap.

    python -m benchmarks.training --out FILE [--case NAME ...] [--seeds 0 1] [--cold]

Each run is a process of its own, made twice: cold, with an empty compilation cache, and warm, with what the first run
compiled; with --cold once. "To the goal" is the time from the start of the process to the first of three successive
evaluations (of all that remain, if the training ends before) whose gap on the training demonstrations is at most the
case's goal. The file contains the report of each run.
"""

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from benchmarks.common.parser import BenchmarkParser
from benchmarks.common.processes import time_to_goal, train
from benchmarks.common.record import Results, print_table


@dataclasses.dataclass(frozen=True)
class Case:
    """A training run.

    Attributes:
      arguments: of `python -m mimic.train`.
      goal: optimality gap to reach.
      on: further arguments, by backend.
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
COLUMNS = {
    "case": "{case}",
    "start": "{start}",
    "seed": "{report[seed]}",
    "gap": "{report[optimality_gap][train]:.2%}",
    "held out": "{report[optimality_gap][held_out]:.2%}",
    "to goal [s]": "{to_goal_s:.1f}",
    "process": "{process_wall_s:.1f}",
    **{stage: f"{{report[wall_time_s][{stage}]:.1f}}" for stage in ("import", "build", "compile", "train", "evaluate")},
    "steps/s": "{report[steps_per_second]:,.0f}",
}


def run_case(name: str, seed: int, starts: Sequence[str] = ("cold", "warm")) -> list[dict[str, Any]]:
    """The run from each start."""
    case = CASES[name]
    arguments = (*case.arguments, *case.on.get(jax.default_backend(), ()), f"seed={seed}")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for start in starts:
            run_dir = Path(folder) / start
            result = train(run_dir, arguments, cache=Path(folder) / "cache")
            to_goal = time_to_goal(run_dir, "optimality_gap.train", case.goal)
            rows.append({"case": name, "start": start, "goal": case.goal, "to_goal_s": to_goal, **result})
    return rows


def main() -> None:
    parser = BenchmarkParser("training", __doc__)
    parser.add_names("--case", CASES)
    parser.add_numbers("--seeds", [0], "of the runs")
    parser.add_argument("--cold", action="store_true", help="no warm runs")
    options = parser.parse_args()
    results, rows = Results("training", options), []
    for name in options.case:
        for seed in options.seeds:
            rows += run_case(name, seed, ("cold",) if options.cold else ("cold", "warm"))
            results.write(runs=rows)
    print_table(rows, COLUMNS)


if __name__ == "__main__":
    main()
