"""Pictures of a run: how it learned, and how near the learner stays to the expert."""

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import matplotlib.ticker  # noqa: E402
import numpy as np  # noqa: E402

if TYPE_CHECKING:
    from mimic.trainers.evaluation import Evaluator, Rollouts

_COLOURS = {"train": "tab:blue", "held_out": "tab:orange"}
_LABELS = {"train": "training", "held_out": "held-out"}


def plot_training(metrics: Path, out: Path, figure_name: str, label: str, *, of: str, title: str) -> None:
    """A figure in percent over the steps, on training and held-out data, from the metrics of a run."""
    with metrics.open(newline="") as file:
        rows = list(csv.DictReader(file))
    steps = [int(row["step"]) for row in rows]
    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for split, colour in _COLOURS.items():
        percent = [100 * float(row[f"quality/{figure_name}.{split}"]) for row in rows]
        axes.plot(steps, percent, "o-", markersize=3, color=colour, label=f"{_LABELS[split]} {of}")
    axes.set(xlabel="steps", ylabel=label, title=title, yscale="log")
    axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    axes.yaxis.set_minor_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    _save(figure, out)


def plot_quality(evaluator: "Evaluator", rollouts: "Rollouts", out: Path, *, title: str) -> None:
    """Mean distance over the time of an episode, between the kinematic bound and holding still."""
    dt = evaluator.env.config.control_dt
    parts = evaluator.parts
    figure, all_axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    for axes, (split, part) in zip(all_axes, parts.items(), strict=True):
        time = dt * np.arange(1, evaluator.env.config.horizon + 1)
        distance = np.asarray(rollouts.distance)[part]
        low, high = np.quantile(distance, [0.1, 0.9], axis=0)
        axes.plot(time, evaluator.hold_distance[part].mean(axis=0), ":", color="grey", label="holding the start pose")
        axes.fill_between(time, low, high, color=_COLOURS[split], alpha=0.2, lw=0, label="policy, 10 to 90 %")
        axes.plot(time, distance.mean(axis=0), color=_COLOURS[split], label="policy, mean")
        axes.plot(time, evaluator.lower_bound[part].mean(axis=0), "k--", lw=1, label="lower bound")
        axes.set(xlabel="time [s]", title=f"{title}, {_LABELS[split]} demonstrations", ylim=(0, None))
        axes.grid(alpha=0.3)
    all_axes[0].set_ylabel("embodiment distance")
    all_axes[0].legend(fontsize="small")
    _save(figure, out)


def plot_demonstrations(evaluator: "Evaluator", rollouts: "Rollouts", out: Path, *, title: str) -> None:
    """Mean distance of each demonstration between its bound and holding still, the worst first."""
    table = evaluator.table(rollouts)
    figure, all_axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    for axes, (split, part) in zip(all_axes, evaluator.parts.items(), strict=True):
        order = np.argsort(-table["optimality_gap"][part])
        bound, distance, hold = (table[key][part][order] for key in ("lower_bound", "mean_distance", "hold_distance"))
        places = np.arange(len(order))
        axes.vlines(places, bound, hold, color="lightgrey", lw=1)
        axes.plot(places, hold, "_", color="grey", label="holding the start pose")
        axes.plot(places, distance, ".", color=_COLOURS[split], label="reached")
        axes.plot(places, bound, "k_", label="lower bound")
        for place in range(min(3, len(order))):
            axes.annotate(
                str(order[place]), (place, distance[place]), textcoords="offset points", xytext=(3, 3), fontsize=7
            )
        axes.set(
            xlabel="demonstration, worst gap first", title=f"{title}, {_LABELS[split]} demonstrations", ylim=(0, None)
        )
        axes.grid(alpha=0.3, axis="y")
    all_axes[0].set_ylabel("mean embodiment distance")
    all_axes[0].legend(fontsize="small")
    _save(figure, out)


def _save(figure: Any, out: Path) -> None:
    figure.savefig(out, dpi=150)
    plt.close(figure)
