"""Policies of the hardware world: in training's physics, on MJX, and on virtual robots in C MuJoCo.

    python -m benchmarks.hardware_world RUN [RUN ...] [--out FILE] [--episodes 1000] [--edge-episodes 200 or 0]

Each run is one of `python -m mimic.train world=hardware`. The gap is that of held-out demonstrations, relative to the
kinematic bound and to holding the start pose. `tracking` is `python -m mimic.evaluate controller=tracking`, a baseline
without learning in the same world: it knows the poses of the bound, which an optimiser computes beforehand, and the
reference of the inner loop, and commands the velocity to the pose that comes `lead` ticks later. `late` is the same if
it knows the reference only as late as a policy observes it. `edges` has each range of the world at its ends, one after
the other, and all together.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect
from mimic.commands.config import ROBOT_LOOPS
from mimic.evaluation.tracking_controllers import run_tracking
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.ppo.trainer import PPOTrainer
from mimic.trainers.run_config import load_config

COLUMNS = (
    "run seed fused:.2% mjx:.2% virtual:.2% ruckig:.2% tracking:.2% lead late:.2% late_lead aborts contacts "
    "edges_worst:.2% edges_together:.2%"
)


def measure(run: Path, episodes: int, edge_episodes: int) -> Row:
    """The row of a run."""
    trained = load_config(run)
    trainer = PPOTrainer(trained, run)
    steps, params = load_checkpoint(run, trainer.params_template())
    fused = trainer.evaluate(params)
    mjx = trainer.cross_check(params)["mjx"]["optimality_gap"]
    (tracking, lead), (late, late_lead) = (
        run_tracking(trainer.evaluator, is_delayed=is_delayed) for is_delayed in (False, True)
    )
    loops = {loop: _virtual(run, episodes, f"robot_loop={loop}")["all ranges"] for loop in ROBOT_LOOPS}
    edges = _virtual(run, edge_episodes, "edges=true") if edge_episodes else {}
    single = {name: case["optimality_gap"] for name, case in edges.items() if not name.startswith("all")}
    together = [case["optimality_gap"] for name, case in edges.items() if name.startswith("all:")]
    return {
        "run": trained.env.name,
        "seed": trained.seed,
        "env_steps": steps,
        "control": trained.env.control,
        "fused": trainer.metrics(fused)["optimality_gap"]["held_out"],
        "mjx": mjx["held_out"],
        "tracking": trainer.metrics(tracking)["optimality_gap"]["held_out"],
        "lead": lead,
        "late": trainer.metrics(late)["optimality_gap"]["held_out"],
        "late_lead": late_lead,
        "virtual": loops["mimic"]["optimality_gap"],
        "ruckig": loops["ruckig"]["optimality_gap"],
        "episodes": sum(cases["episodes"] for cases in loops.values()),
        "aborts": sum(sum(cases["aborts"].values()) for cases in loops.values()),
        "contacts": sum(cases["self_contacts"] for cases in loops.values()),
        **({"edges_worst": max(single.values()), "edges_together": max(together)} if edges else {}),
    }


def _virtual(run: Path, episodes: int, *options: str) -> dict[str, Any]:
    """The cases of an evaluation on virtual robots."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "report"
        command = [sys.executable, "-m", "mimic.evaluate", f"run={run}", "robot=virtual_panda", f"out={out}"]
        subprocess.run([*command, f"episodes={episodes}", *options], check=True, stdout=subprocess.DEVNULL)
        return json.loads((out / "report.json").read_text())["cases"]


def main() -> None:
    """Measures and prints."""
    parser = make_parser("hardware_world", __doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--edge-episodes", type=int, default=200)
    options = parser.parse_args()
    rows = (measure(run, options.episodes, options.edge_episodes) for run in options.runs)
    collect(options, rows, "runs", COLUMNS)


if __name__ == "__main__":
    main()
