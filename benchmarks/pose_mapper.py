"""Pose mappers trained as a user does: quality, training time, and poses per second.

    python -m benchmarks.pose_mapper --out FILE [--seeds 0 1 2] [--plot FILE]

The time to the goal is from the start of the process until the mean distance of unseen poses is within 2 % of the
optimum.
"""

import itertools
import tempfile
from collections.abc import Sequence
from pathlib import Path

import jax
import matplotlib.ticker
import numpy as np

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.processes import read_metrics, time_to_goal, train
from benchmarks.common.record import Row, collect
from benchmarks.common.timing import time_program
from benchmarks.figures.canvas import plt, save

ENVIRONMENTS = ("planar4dof", "planar7dof", "panda7dof", "panda4dof", "panda3dof")
PRESETS = ("paper", "large")
BATCH = 100_000
GOAL = 0.02  # above the optimum, on unseen poses
COLUMNS = (
    "report[env] report[seed] preset report[quality][train]:.2% report[quality][held_out]:.2% "
    "to_goal_s:.1f process_wall_s:.1f poses_per_second:,.0f"
)
SPLITS = {"train": ("training poses", "--"), "held_out": ("unseen poses", "-")}


def run(preset: str, env: str, seed: int) -> Row:
    arguments = ["trainer=pose_mapper", f"trainer.preset={preset}", f"env={env}", f"seed={seed}"]
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        result = train(run_dir, arguments)
        mapper = mimic.PoseMapper.load(run_dir)
        metrics = np.transpose(read_metrics(run_dir, "step", *(f"quality/quality.{split}" for split in SPLITS)))
        to_goal = time_to_goal(run_dir, "quality.held_out", GOAL)
    lower, upper = mapper.expert.joint_range.T
    qpos = np.random.default_rng(0).uniform(lower, upper, (BATCH, len(lower))).astype(np.float32)
    rate = BATCH / time_program(mapper, jax.device_put(qpos)).median
    curves = {split: values.round(6).tolist() for split, values in zip(SPLITS, metrics[1:], strict=True)}
    curves["training_poses"] = metrics[0].astype(int).tolist()
    case = {"preset": preset, **result, "curves": curves}
    return {**case, "poses_per_second": rate, "to_goal_s": to_goal}


def plot(rows: Sequence[Row], out: Path) -> None:
    presets = list(dict.fromkeys(row["preset"] for row in rows))
    size = (2.2 + 3.6 * len(presets), 3.8)
    figure, panels = plt.subplots(1, len(presets), figsize=size, sharey=True, layout="constrained", squeeze=False)
    for axes, preset in zip(panels[0], presets, strict=True):
        chosen = [r for r in rows if r["preset"] == preset and r["report"]["seed"] == rows[0]["report"]["seed"]]
        for index, row in enumerate(chosen):
            for split, (label, style) in SPLITS.items():
                percent = 100 * np.asarray(row["curves"][split])
                name = f"{row['report']['env']}, {label}" if preset == presets[0] else None
                axes.plot(row["curves"]["training_poses"], percent, style, color=f"C{index}", lw=1.2, label=name)
        axes.set(xlabel="training poses", title=f"preset {preset}", xscale="log", yscale="log")
        axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        axes.xaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
        axes.grid(alpha=0.3)
    panels[0, 0].set_ylabel("above the optimum [%]")
    figure.legend(loc="outside right center", fontsize="x-small")
    save(figure, out)


def main() -> None:
    lists = {"preset": PRESETS, "env": ENVIRONMENTS, "seeds": [0, 1, 2]}
    options = make_parser("pose_mapper", __doc__, **lists, plot=Path).parse_args()
    cases = itertools.product(options.preset, options.env, options.seeds)
    rows = collect(options, (run(*case) for case in cases), "runs", COLUMNS, batch=BATCH)
    if options.plot:
        plot(rows, options.plot)


if __name__ == "__main__":
    main()
