"""Plots of a run: its training, and the learner's distance and similarity to the expert."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.ticker
import numpy as np
from matplotlib.figure import Figure

from mimic.base.files import read_text
from mimic.evaluation.labels import SIMILARITY_HEADERS, SIMILARITY_NAMES, SPLIT_NAMES
from mimic.evaluation.rollout_metrics import WORST
from mimic.runs.files import METRICS

if TYPE_CHECKING:
    from mimic.evaluation.evaluator import Evaluator, Rollouts

_COLOURS = {"train": "tab:blue", "held_out": "tab:orange"}
_LABELS = {split: name.replace(" ", "-") for split, name in SPLIT_NAMES.items()}  # adjectives: held-out demonstrations


def plot_training(folder: Path, metric: str, label: str, *, labels: Mapping[str, str], title: str) -> None:
    """Plots a metric in percent over the steps, with a label for each split; nothing if the folder has no run."""
    log = folder / METRICS
    if not log.is_file():
        return
    rows = list(csv.DictReader(read_text(log).splitlines()))
    steps = [int(row["step"]) for row in rows]
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    for split, colour in _COLOURS.items():
        column = f"quality/{metric}.{split}"
        if column not in rows[0]:  # many arms, none of which is in this split
            continue
        percent = [100 * float(row[column]) for row in rows]
        axes.plot(steps, percent, "o-", markersize=3, color=colour, label=labels[split])
    axes.set(xlabel="steps", ylabel=label, title=title, yscale="log")
    axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    axes.yaxis.set_minor_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(folder / "training.png", dpi=150)


def labels_of(data: str) -> dict[str, str]:
    """A label for each split of data, such as demonstrations."""
    return {split: f"{label} {data}" for split, label in _LABELS.items()}


def plot_quality(evaluator: "Evaluator", rollouts: "Rollouts", out: Path, *, controller: str, title: str) -> None:
    """Plots the mean distance over the time of an episode, with the kinematic bound and holding the start pose."""
    time = evaluator.env.config.control_dt * np.arange(1, evaluator.env.config.horizon + 1)
    figure = Figure(figsize=(9, 4), layout="constrained")
    all_axes = figure.subplots(1, 2, sharey=True)
    for axes, (split, part) in zip(all_axes, evaluator.parts.items(), strict=True):
        distance = np.asarray(rollouts.distance)[part]
        low, high = np.quantile(distance, [0.1, 0.9], axis=0)
        axes.plot(time, evaluator.hold_distance[part].mean(axis=0), ":", color="grey", label="holding the start pose")
        axes.plot(time, distance.mean(axis=0), color=_COLOURS[split], label=f"{controller}, mean")
        axes.fill_between(time, low, high, color=_COLOURS[split], alpha=0.2, lw=0, label=f"{controller}, 10 to 90 %")
        axes.plot(time, evaluator.lower_bound[part].mean(axis=0), "k--", lw=1, label="kinematic bound")
        axes.set(xlabel="time [s]", title=f"{_LABELS[split]} demonstrations: {len(distance)}")
        axes.grid(alpha=0.3)
    all_axes[0].set(ylabel="embodiment distance", ylim=(0, None))  # shared, so after all is drawn
    _finish(figure, all_axes[0], f"{title}: {controller}", out)


def plot_demonstrations(
    evaluator: "Evaluator", rollouts: "Rollouts", out: Path, *, controller: str, title: str
) -> None:
    """Plots the gap of each demonstration, the worst first, and below it the distances that define it."""
    table, parts = evaluator.table(rollouts), evaluator.parts
    counts = [len(table["optimality_gap"][part]) for part in parts.values()]
    widths = [max(count, max(counts) / 3) for count in counts]
    figure = Figure(figsize=(9, 6), layout="constrained")
    rows = figure.subplots(2, 2, sharex="col", sharey="row", width_ratios=widths)
    for (above, below), count, (split, part) in zip(rows.T, counts, parts.items(), strict=True):
        order = np.argsort(-table["optimality_gap"][part])
        place = np.arange(1, count + 1)
        gap, bound, distance, hold = (
            table[key][part][order] for key in ("optimality_gap", "lower_bound", "mean_distance", "hold_distance")
        )
        above.plot(place, 100 * gap, ".", color=_COLOURS[split])
        for x, y, number in zip(place, 100 * gap, order[:WORST], strict=False):
            above.annotate(str(number), (x, y), textcoords="offset points", xytext=(4, 2), fontsize=7)
        below.vlines(place, bound, hold, color="lightgrey", lw=1)
        below.plot(place, hold, "_", color="grey", markersize=4, label="holding the start pose")
        below.plot(place, distance, ".", color=_COLOURS[split], label=controller)
        below.plot(place, bound, "k_", markersize=4, label="kinematic bound")
        above.set(title=f"{_LABELS[split]}: {count}")
        below.set(xlabel="rank, worst gap first", xlim=(0, count + 1))
        below.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(7, integer=True, min_n_ticks=1))
        above.margins(y=0.12)  # room for the numbers of the worst
        for axes in (above, below):
            axes.grid(alpha=0.3, axis="y")
    rows[0, 0].set(ylabel="optimality gap [%]", ylim=(min(0, 100 * np.nanmin([0.0, *table["optimality_gap"]])), None))
    rows[1, 0].set(ylabel="mean embodiment distance", ylim=(0, None))
    _finish(figure, rows[1, 0], f"{title}: {controller}, each demonstration; the worst by their numbers", out)


def plot_similarity(similarity: Mapping[str, Mapping[str, Mapping[str, float]]], out: Path, *, title: str) -> None:
    """Plots bars of each measure of similarity, for the controller and each baseline, by split."""
    names = list(similarity)
    figure = Figure(figsize=(12, 0.42 * len(names) + 1.6), layout="constrained")
    all_axes = figure.subplots(1, len(SIMILARITY_HEADERS), sharey=True)
    place = np.arange(len(names))
    for axes, (key, header) in zip(all_axes, SIMILARITY_HEADERS.items(), strict=True):
        for offset, (split, colour) in zip((-0.2, 0.2), _COLOURS.items(), strict=True):
            values = [similarity[name][key][split] for name in names]
            axes.barh(place + offset, values, 0.4, color=colour, label=f"{_LABELS[split]} demonstrations")
        unit = "deg" if key.endswith("_deg") else "chain lengths"
        axes.set(title=header.replace("\n", " "), xlabel=unit)
        axes.grid(alpha=0.3, axis="x")
    all_axes[0].set_yticks(place, [SIMILARITY_NAMES.get(name, name.replace("_", " ")) for name in names])
    all_axes[0].invert_yaxis()
    _finish(
        figure,
        all_axes[0],
        f"{title}: similarity of the motions (0 is identical), with baselines without learning",
        out,
    )


def _finish(figure: Any, labelled: Any, title: str, out: Path) -> None:
    """Adds a title, and one legend below all axes, where it hides no data."""
    figure.suptitle(title)
    handles, labels = labelled.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize="small")
    figure.savefig(out, dpi=150)
