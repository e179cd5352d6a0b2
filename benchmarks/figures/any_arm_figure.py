"""The gap of the controller of any arm, for each arm and over the number of joints.

python -m benchmarks.figures.any_arm_figure RESULTS.json [MORE.json ...] OUT.png
"""

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from mimic.evaluation.rollout_metrics import MIN_SPAN


def draw(results: dict[str, Any], out: Path) -> None:
    """Draws the arms with names as bars, and the random arms as points.

    Args:
      results: rows by kind of arm, as `benchmarks.any_arm` writes them; `report`: more random arms, those of reports;
        and `rows`: gaps of policies of one arm.
      out: image file.
    """
    named = [row for kind in ("presets", "locks", "real") for row in results.get(kind, []) if row["span"] >= MIN_SPAN]
    random = [row for kind in ("random", "report") for row in results.get(kind, []) if row["span"] >= MIN_SPAN]
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4), width_ratios=[2.2, 1], layout="constrained")
    places = np.arange(len(named))
    left.bar(places, [100 * row["gap"] for row in named], color="#9db8d9", label="whole episode")
    left.bar(places, [100 * row["late"] for row in named], width=0.4, color="#1f4e8c", label="second half")
    specialists = {row["arm"]: 100 * row["gap"]["held_out"] for row in results.get("rows", [])}
    shown = [place for place, row in zip(places, named, strict=True) if row["arm"] in specialists]
    if shown:
        gaps = [specialists[named[place]["arm"]] for place in shown]
        left.plot(shown, gaps, "_", color="#c2410c", markersize=14, markeredgewidth=2, label="PPO of this arm alone")
    left.set_xticks(places, [row["arm"] for row in named], rotation=90, fontsize=8)
    left.set(ylabel="optimality gap [%]", title="Locked joints of the Panda, and real arms")
    left.legend(frameon=False)
    jitter = np.random.default_rng(0).uniform(-0.25, 0.25, len(random))
    joints = np.array([row["joints"] for row in random])
    for key, colour, label in (("gap", "#9db8d9", "whole episode"), ("late", "#1f4e8c", "second half")):
        values = 100 * np.array([row[key] for row in random])
        right.scatter(joints + jitter, np.maximum(values, 0.01), s=8, color=colour, label=label)
        medians = [np.median(values[joints == count]) for count in np.unique(joints)]
        right.plot(np.unique(joints), medians, color=colour, marker="_", markersize=24, linewidth=1)
    right.set(yscale="log", xlabel="joints", title="Random arms, and their medians")
    right.legend(frameon=False)
    figure.savefig(out, dpi=110)


def main() -> None:
    """Runs the command."""
    *files, out = map(Path, sys.argv[1:])
    draw({key: value for file in files for key, value in json.loads(file.read_text()).items()}, out)


if __name__ == "__main__":
    main()
