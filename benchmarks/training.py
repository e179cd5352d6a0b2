"""Training on one demonstration as a user starts it: quality, speed, and time until a gap of 2 %.

    python -m benchmarks.training --out FILE [--seeds 0 1] [--cold]

Each run is made cold, with an empty compilation cache, and warm, with what the cold run compiled. "To the goal" is the
time from the start of the process to the first of three successive evaluations with at most this gap on the training
demonstration.
"""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax

from benchmarks.common.parser import make_parser
from benchmarks.common.processes import time_to_goal, train
from benchmarks.common.record import Row, collect

SHORT = {
    "gpu": "trainer.num_timesteps=15000000 trainer.evaluations=15",
    "cpu": "trainer.num_timesteps=800000 trainer.evaluations=8",
}
GOAL = 0.02  # optimality gap on the training demonstration
ARGUMENTS = ("env=panda7dof", "env.demonstrations.count=1")
COLUMNS = (
    "start report[seed] report[optimality_gap][train]:.2% report[optimality_gap][held_out]:.2% to_goal_s:.1f "
    "process_wall_s:.1f report[wall_time_s][compile]:.1f report[steps_per_second]:,.0f"
)


def run_seed(seed: int, starts: Sequence[str]) -> Iterator[Row]:
    arguments = [*ARGUMENTS, *SHORT.get(jax.default_backend(), "").split(), f"seed={seed}"]
    with tempfile.TemporaryDirectory() as folder:
        for start in starts:
            run_dir = Path(folder) / start
            result = train(run_dir, arguments, cache=Path(folder) / "cache")
            to_goal = time_to_goal(run_dir, "optimality_gap.train", GOAL)
            yield {"start": start, "goal": GOAL, "to_goal_s": to_goal, **result}


def main() -> None:
    options = make_parser("training", __doc__, seeds=[0], cold=False).parse_args()
    starts = ("cold",) if options.cold else ("cold", "warm")
    rows = (row for seed in options.seeds for row in run_seed(seed, starts))
    collect(options, rows, "runs", COLUMNS)


if __name__ == "__main__":
    main()
