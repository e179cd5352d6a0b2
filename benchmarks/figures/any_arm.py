"""The figure of docs/any_arm.md.

    python -m benchmarks.figures.any_arm RESULTS.json [MORE.json ...] OUT.png

The gap of the controller without training, for each arm and over the number of joints.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures.canvas import plt, save
from mimic.evaluation.rollout_metrics import MIN_SPAN

DARK, LIGHT = "#1f4e8c", "#9db8d9"


def draw_controller(results: dict[str, Any], out: Path) -> None:
    """Draws the arms with names as bars, and the random arms as points.

    Args:
      results: rows by kind of arm, as `benchmarks.any_arm` writes them.
      out: image file.
    """
    named = [row for kind in ("locks", "real") for row in results.get(kind, []) if row["span"] >= MIN_SPAN]
    random = [row for row in results.get("random", []) if row["span"] >= MIN_SPAN]
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


def main() -> None:
    """Runs the command."""
    *files, out = sys.argv[1:]
    results = [json.loads(Path(file).read_text()) for file in files]
    draw_controller({key: value for content in results for key, value in content.items()}, Path(out))


if __name__ == "__main__":
    main()
