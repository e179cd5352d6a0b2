"""How near a mapper to any arm comes to the optimum, over the number of distinct arms of its training.

python -m benchmarks.figures.any_arm_curve RESULTS.json OUT.png
"""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures.canvas import plt, save

COLOURS = {"unseen locks": "#1f4e8c", "real arms": "#c2410c", "random arms": "#4d7c0f"}
SERIES = {
    "quality": ("with four Newton steps", "-", 1.0),
    "quality_proposed": ("its proposals alone", ":", 1.0),
    "quality_random_guesses": ("eight random initial guesses, four Newton steps", "--", 0.5),
}


def draw(rows: Sequence[Mapping[str, Any]], out: Path) -> None:
    """Draws the mean of the seeds as a line for each group of arms and each series, and each mapper as a point.

    Args:
      rows: one for each number of distinct arms, with a list `seeds` of trainings that have a dict `groups`.
      out: image file.
    """
    figure, axes = plt.subplots(figsize=(10, 4), layout="constrained")
    names = [f"{row['distinct']:,}" if row["distinct"] else "a new one\nfor each pose" for row in rows]
    for group, colour in COLOURS.items():
        for key, (_, style, alpha) in SERIES.items():
            values = np.array([[100 * seed["groups"][group][key] for seed in row["seeds"]] for row in rows])
            axes.plot(names, values.mean(axis=1), style, color=colour, alpha=alpha)
            if key == "quality":
                axes.plot(names, values, "o", color=colour, markersize=4)
    for group, colour in COLOURS.items():
        axes.plot([], [], color=colour, label=group)
    for label, style, alpha in SERIES.values():
        axes.plot([], [], style, color="black", alpha=alpha, label=label)
    axes.set(yscale="log", xlabel="distinct arms of the training", ylabel="above the optimum [%]")
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    save(figure, out)


def main() -> None:
    """Runs the command."""
    results, out = map(Path, sys.argv[1:])
    draw(json.loads(results.read_text())["rows"], out)


if __name__ == "__main__":
    main()
