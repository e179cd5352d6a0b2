"""Trains pose mappers as a user does, each a process of its own: quality, training time, and poses per second.

    python -m benchmarks.pose_mapper --out FILE [--seeds 0 1 2] [--plot FILE]
    python -m benchmarks.pose_mapper --out FILE --regularisation --preset paper --env panda4dof --seeds 0 1

"Within 2 %" is the time from the start of the process until the mean distance of unseen poses has come so near to the
optimum. The file holds each run's report, its curves, and the mapper's speed on a batch; the plot shows training and
unseen poses over training for both presets. `--regularisation` trains each with dropout and with weight decay too.
"""

import argparse
import csv
import itertools
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np
from rich.console import Console
from rich.table import Table

import mimic
from benchmarks.record import time_to_goal, train, write_results

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

ENVIRONMENTS = ("planar4dof", "planar7dof", "panda7dof", "panda4dof", "panda3dof")
PRESETS = ("paper", "large")
BATCH, REPEATS = 100_000, 5
GOAL = 0.02  # above the optimum, on unseen poses
# What the paper proposes against overfitting; it gives no values. The decay is AdamW's, in units of the learning rate.
REGULARISATION: dict[str, tuple[str, ...]] = {
    "none": (),
    "dropout 0.05": ("trainer.dropout=0.05",),
    "dropout 0.2": ("trainer.dropout=0.2",),
    "weight decay 0.1": ("trainer.weight_decay=0.1",),
    "weight decay 1": ("trainer.weight_decay=1",),
}
_SPLITS = {"train": ("training poses", "--"), "held_out": ("unseen poses", "-")}


def poses_per_second(run_dir: Path, batch: int) -> float:
    """Speed of a trained mapper on a batch, once it is compiled; the median of some repeats."""
    mapper = mimic.PoseMapper.load(run_dir)
    lower, upper = mapper.expert.joint_range.T
    qpos = jax.device_put(np.random.default_rng(0).uniform(lower, upper, (batch, len(lower))).astype(np.float32))
    program = jax.jit(mapper)
    jax.block_until_ready(program(qpos))
    seconds = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        jax.block_until_ready(program(qpos))
        seconds.append(time.perf_counter() - began)
    return batch / float(np.median(seconds))


def curves(run_dir: Path) -> dict[str, list[float]]:
    """Quality on training and unseen poses after each evaluation."""
    with (run_dir / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    quality = {split: [round(float(row[f"quality/quality.{split}"]), 6) for row in rows] for split in _SPLITS}
    return {"training_poses": [int(row["step"]) for row in rows], **quality}


def plot(results: Sequence[dict[str, Any]], out: Path) -> None:
    """Curves of the first seed, a panel for each preset."""
    presets = list(dict.fromkeys(result["preset"] for result in results))
    figure, all_axes = plt.subplots(
        1, len(presets), figsize=(2.2 + 3.6 * len(presets), 3.8), sharey=True, layout="constrained", squeeze=False
    )
    all_axes, first_seed = all_axes[0], results[0]["report"]["seed"]
    for axes, preset in zip(all_axes, presets, strict=True):
        shown = [r for r in results if r["preset"] == preset and r["report"]["seed"] == first_seed]
        for index, result in enumerate(shown):
            curve = result["curves"]
            for split, (label, style) in _SPLITS.items():
                percent = 100 * np.asarray(curve[split])
                name = f"{result['report']['env']}, {label}" if preset == presets[0] else None
                axes.plot(curve["training_poses"], percent, style, color=f"C{index}", lw=1.2, label=name)
        axes.set(xlabel="training poses", title=f"preset {preset}", xscale="log", yscale="log")
        axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))  # type: ignore[attr-defined]
        axes.xaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())  # type: ignore[attr-defined]
        axes.grid(alpha=0.3)
    all_axes[0].set_ylabel("above the optimum [%]")
    figure.legend(loc="outside right center", fontsize="x-small")
    figure.savefig(out, dpi=150)
    plt.close(figure)


def _table(results: Sequence[dict[str, Any]]) -> Table:
    table = Table(
        "env", "preset", "regularisation", "training", "unseen", "angle to optimum", "within 2 %", "process", "poses/s"
    )
    for result in results:
        report = result["report"]
        angles = report["link_angle_to_optimum_deg_by_link"].values()
        table.add_row(
            f"{report['env']} {report['seed']}",
            result["preset"],
            result["regularisation"],
            f"{report['quality']['train']:.2%}",
            f"{report['quality']['held_out']:.2%}",
            " ".join(f"{angle:.1f}" for angle in angles),
            "-" if result["to_goal_s"] is None else f"{result['to_goal_s']:.1f} s",
            f"{result['process_wall_s']:.1f} s",
            f"{result['poses_per_second']:,.0f}",
        )
    return table


def main() -> None:
    """Trains all, and writes the file after each run."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.pose_mapper", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--out", type=Path, help="file of results; printed only where none is given")
    parser.add_argument("--plot", type=Path, help="picture of the curves")
    parser.add_argument("--preset", choices=PRESETS, action="append", help="only this one (may be repeated)")
    parser.add_argument("--env", choices=ENVIRONMENTS, action="append", help="only this one (may be repeated)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], metavar="N")
    parser.add_argument("--regularisation", action="store_true", help="each without and with dropout, weight decay")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()
    variants = REGULARISATION if options.regularisation else {"none": ()}
    names = options.preset or PRESETS, options.env or ENVIRONMENTS, variants, options.seeds
    results = []
    for preset, env, variant, seed in itertools.product(*names):
        with tempfile.TemporaryDirectory() as folder:
            run_dir = Path(folder) / "run"
            arguments = ["trainer=pose_mapper", f"trainer.preset={preset}", f"env={env}", f"seed={seed}"]
            result = {"preset": preset, "regularisation": variant, **train(run_dir, [*arguments, *variants[variant]])}
            result |= {"curves": curves(run_dir), "poses_per_second": poses_per_second(run_dir, BATCH)}
            result["to_goal_s"] = time_to_goal(run_dir, "quality.held_out", GOAL)
        results.append(result)
        if options.out:
            write_results(options.out, "pose_mapper", options.commit, batch=BATCH, runs=results)
    if options.plot:
        plot(results, options.plot)
    Console(width=140).print(_table(results))  # also where there is no terminal


if __name__ == "__main__":
    main()
