"""Pose mappers trained as a user does: quality, training time, and poses per second.

    python -m benchmarks.pose_mapper --out FILE [--seeds 0 1 2] [--plot FILE]
    python -m benchmarks.pose_mapper --out FILE --regularisation --preset paper --env panda4dof --seeds 0 1

Each run is a process of its own. "Within 2 %" is the time from its start until the mean distance of unseen poses is
that near to the optimum. The file contains the report of each run, its curves, and the mapper's speed on a batch; the
plot shows training and unseen poses over training. `--regularisation` trains each also with dropout and weight decay.
"""

import itertools
import tempfile
from collections.abc import Sequence
from pathlib import Path

import jax
import matplotlib.ticker
import numpy as np

import mimic
from benchmarks.common.parser import BenchmarkParser
from benchmarks.common.processes import read_metrics, time_to_goal, train
from benchmarks.common.record import Results, Row, print_table
from benchmarks.common.timing import time_program
from benchmarks.figures.canvas import plt, save

ENVIRONMENTS = ("planar4dof", "planar7dof", "panda7dof", "panda4dof", "panda3dof")
PRESETS = ("paper", "large")
BATCH = 100_000
GOAL = 0.02  # above the optimum, on unseen poses
# The paper's proposals against overfitting, without values. The decay is AdamW's, in units of the learning rate.
REGULARISATION: dict[str, tuple[str, ...]] = {
    "none": (),
    "dropout 0.05": ("trainer.dropout=0.05",),
    "dropout 0.2": ("trainer.dropout=0.2",),
    "weight decay 0.1": ("trainer.weight_decay=0.1",),
    "weight decay 1": ("trainer.weight_decay=1",),
}
COLUMNS = {
    "env": "{report[env]} {report[seed]}",
    "preset": "{preset}",
    "regularisation": "{regularisation}",
    "training": "{report[quality][train]:.2%}",
    "unseen": "{report[quality][held_out]:.2%}",
    "within 2 % [s]": "{to_goal_s:.1f}",
    "process [s]": "{process_wall_s:.1f}",
    "poses/s": "{poses_per_second:,.0f}",
}
_SPLITS = {"train": ("training poses", "--"), "held_out": ("unseen poses", "-")}


def poses_per_second(run_dir: Path, batch: int) -> float:
    """Speed of a trained mapper on a batch."""
    mapper = mimic.PoseMapper.load(run_dir)
    lower, upper = mapper.expert.joint_range.T
    qpos = np.random.default_rng(0).uniform(lower, upper, (batch, len(lower))).astype(np.float32)
    return batch / time_program(mapper, jax.device_put(qpos)).median


def curves(run_dir: Path) -> dict[str, list[float]]:
    """Quality on training and unseen poses after each evaluation."""
    steps, *quality = zip(*read_metrics(run_dir, "step", *(f"quality/quality.{split}" for split in _SPLITS)), strict=True)
    rounded = {split: [round(x, 6) for x in values] for split, values in zip(_SPLITS, quality, strict=True)}
    return {"training_poses": [int(step) for step in steps], **rounded}


def plot(rows: Sequence[Row], out: Path) -> None:
    """Curves of the first seed, a panel for each preset."""
    presets = list(dict.fromkeys(row["preset"] for row in rows))
    size = (2.2 + 3.6 * len(presets), 3.8)
    figure, panels = plt.subplots(1, len(presets), figsize=size, sharey=True, layout="constrained", squeeze=False)
    for axes, preset in zip(panels[0], presets, strict=True):
        chosen = [r for r in rows if r["preset"] == preset and r["report"]["seed"] == rows[0]["report"]["seed"]]
        for index, row in enumerate(chosen):
            for split, (label, style) in _SPLITS.items():
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
    parser = BenchmarkParser("pose_mapper", __doc__)
    parser.add_argument("--plot", type=Path, metavar="FILE", help="picture of the curves")
    parser.add_names("--preset", PRESETS)
    parser.add_names("--env", ENVIRONMENTS)
    parser.add_numbers("--seeds", [0, 1, 2], "of the runs")
    parser.add_argument("--regularisation", action="store_true", help="each also with dropout and weight decay")
    options = parser.parse_args()
    variants = REGULARISATION if options.regularisation else {"none": ()}
    results, rows = Results("pose_mapper", options), []
    for preset, env, variant, seed in itertools.product(options.preset, options.env, variants, options.seeds):
        arguments = ["trainer=pose_mapper", f"trainer.preset={preset}", f"env={env}", f"seed={seed}", *variants[variant]]
        with tempfile.TemporaryDirectory() as folder:
            run_dir = Path(folder) / "run"
            row = {"preset": preset, "regularisation": variant, **train(run_dir, arguments)}
            row |= {"curves": curves(run_dir), "poses_per_second": poses_per_second(run_dir, BATCH)}
            row["to_goal_s"] = time_to_goal(run_dir, "quality.held_out", GOAL)
        rows.append(row)
        results.write(batch=BATCH, runs=rows)
    if options.plot:
        plot(rows, options.plot)
    print_table(rows, COLUMNS)


if __name__ == "__main__":
    main()
