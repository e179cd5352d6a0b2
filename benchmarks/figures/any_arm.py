"""Figures of docs/any_arm.md.

    python -m benchmarks.figures.any_arm controller RESULTS.json [MORE.json ...] OUT.png
    python -m benchmarks.figures.any_arm mapper RESULTS.json OUT.png

controller: the gap of the controller without training, for each arm and over the number of joints. mapper: how
near a mapper to any arm comes to the optimum, over the number of distinct arms of its training.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures.canvas import plt, save
from mimic.evaluation.rollout_metrics import MIN_SPAN

DARK, LIGHT = "#1f4e8c", "#9db8d9"
GROUPS = {"unseen locks": "#1f4e8c", "real arms": "#c2410c", "random arms": "#4d7c0f"}
SERIES = {
    "quality": ("with four Newton steps", "-", 1.0),
    "quality_proposed": ("its proposals alone", ":", 1.0),
    "quality_random_guesses": ("eight random initial guesses, four Newton steps", "--", 0.5),
}


def draw_controller(results: dict[str, Any], out: Path) -> None:
    """Draws the arms with names as bars, and the random arms as points.

    Args:
      results: rows by kind of arm, as `benchmarks.any_arm` writes them; `report`: more random arms, those of reports.
      out: image file.
    """
    named = [row for kind in ("presets", "locks", "real") for row in results.get(kind, []) if row["span"] >= MIN_SPAN]
    random = [row for kind in ("random", "report") for row in results.get(kind, []) if row["span"] >= MIN_SPAN]
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4), width_ratios=[2.2, 1], layout="constrained")
    places = np.arange(len(named))
    left.bar(places, [100 * row["gap"] for row in named], color=LIGHT, label="whole episode")
    left.bar(places, [100 * row["late"] for row in named], width=0.4, color=DARK, label="second half")
    left.set_xticks(places, [row["arm"] for row in named], rotation=90, fontsize=8)
    left.set(ylabel="optimality gap [%]", title="Locked joints of the Panda, and real arms")
    left.legend(frameon=False)
    jitter = np.random.default_rng(0).uniform(-0.25, 0.25, len(random))
    joints = np.array([row["joints"] for row in random])
    for key, colour, label in (("gap", LIGHT, "whole episode"), ("late", DARK, "second half")):
        values = 100 * np.array([row[key] for row in random])
        right.scatter(joints + jitter, np.maximum(values, 0.01), s=8, color=colour, label=label)
        medians = [np.median(values[joints == count]) for count in np.unique(joints)]
        right.plot(np.unique(joints), medians, color=colour, marker="_", markersize=24, linewidth=1)
    right.set(yscale="log", xlabel="joints", title="Random arms, and their medians")
    right.legend(frameon=False)
    save(figure, out)


def draw_mapper(rows: Sequence[Mapping[str, Any]], out: Path) -> None:
    """Draws the mean of the seeds as a line for each group of arms and each series, and each mapper as a point.

    Args:
      rows: one for each number of distinct arms, with a list `seeds` of trainings that have a dict `groups`.
      out: image file.
    """
    figure, axes = plt.subplots(figsize=(10, 4), layout="constrained")
    names = [f"{row['distinct']:,}" if row["distinct"] else "a new one\nfor each pose" for row in rows]
    for group, colour in GROUPS.items():
        for key, (_, style, alpha) in SERIES.items():
            values = np.array([[100 * seed["groups"][group][key] for seed in row["seeds"]] for row in rows])
            axes.plot(names, values.mean(axis=1), style, color=colour, alpha=alpha)
            if key == "quality":
                axes.plot(names, values, "o", color=colour, markersize=4)
    for group, colour in GROUPS.items():
        axes.plot([], [], color=colour, label=group)
    for label, style, alpha in SERIES.values():
        axes.plot([], [], style, color="black", alpha=alpha, label=label)
    axes.set(yscale="log", xlabel="distinct arms of the training", ylabel="above the optimum [%]")
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    save(figure, out)


def main() -> None:
    """Runs the command."""
    kind, *files, out = sys.argv[1:]
    results = [json.loads(Path(file).read_text()) for file in files]
    if kind == "controller":
        draw_controller({key: value for content in results for key, value in content.items()}, Path(out))
    elif kind == "mapper":
        draw_mapper(results[0]["rows"], Path(out))
    else:
        sys.exit(f"expected controller or mapper, got {kind!r}")


if __name__ == "__main__":
    main()
