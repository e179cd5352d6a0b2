"""Training runs as a user starts them: quality, speed, and time until a stated gap.

    python -m benchmarks.training --out FILE [--case NAME ...] [--seeds 0 1] [--cold]

Each run is made cold, with an empty compilation cache, and warm, with what the cold run compiled. "To the goal" is the
time from the start of the process to the first of three successive evaluations with at most the case's gap on the
training demonstrations.
"""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax

from benchmarks.common.parser import make_parser
from benchmarks.common.processes import time_to_goal, train
from benchmarks.common.record import Row, collect


class Case(NamedTuple):
    """The optimality gap to reach, arguments of `python -m mimic.train`, and further ones by backend."""

    goal: float
    arguments: str
    on: dict[str, str] = {}


SHORT = {
    "gpu": "trainer.num_timesteps=15000000 trainer.evaluations=15",
    "cpu": "trainer.num_timesteps=800000 trainer.evaluations=8",
}
CASES = {
    "one_demonstration": Case(0.02, "env=panda7dof env.demonstrations.count=1", SHORT),
    "panda7dof": Case(0.02, "env=panda7dof"),
    "panda4dof": Case(0.03, "env=panda4dof"),
    "panda3dof": Case(0.03, "env=panda3dof"),
}
COLUMNS = (
    "case start report[seed] report[optimality_gap][train]:.2% report[optimality_gap][held_out]:.2% to_goal_s:.1f "
    "process_wall_s:.1f report[wall_time_s][compile]:.1f report[steps_per_second]:,.0f"
)


def run_case(name: str, seed: int, starts: Sequence[str]) -> Iterator[Row]:
    case = CASES[name]
    arguments = [*f"{case.arguments} {case.on.get(jax.default_backend(), '')}".split(), f"seed={seed}"]
    with tempfile.TemporaryDirectory() as folder:
        for start in starts:
            run_dir = Path(folder) / start
            result = train(run_dir, arguments, cache=Path(folder) / "cache")
            to_goal = time_to_goal(run_dir, "optimality_gap.train", case.goal)
            yield {"case": name, "start": start, "goal": case.goal, "to_goal_s": to_goal, **result}


def main() -> None:
    options = make_parser("training", __doc__, case=CASES, seeds=[0], cold=False).parse_args()
    starts = ("cold",) if options.cold else ("cold", "warm")
    rows = (row for name in options.case for seed in options.seeds for row in run_case(name, seed, starts))
    collect(options, rows, "runs", COLUMNS)


if __name__ == "__main__":
    main()
