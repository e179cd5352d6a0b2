"""The gap of one policy for any arm, beside the controller without training and policies of one arm.

python -m benchmarks.figures.any_arm_policy POLICY.json OUTSIDE.json OUT.png
"""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures.canvas import plt, save

POLICY, CONTROLLER, SPECIALIST = "#1f4e8c", "#9db8d9", "#c2410c"
FLOOR = 0.05  # %, the lowest gap that is shown


def draw(
    rows: Sequence[Mapping[str, Any]],
    outside: Sequence[Mapping[str, Any]],
    out: Path,
) -> None:
    """Draws arms with a specialist on the left; random arms by joints, and arms outside the distribution, on the right.

    Args:
      rows: gaps of arms, `controller_gap` and `seed_0` to `seed_2`, with the number of `joints`; `specialist_gap` of
        the policy of this arm alone, where there is one.
      outside: the same of arms outside the distribution, with one seed.
      out: image file.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.5), width_ratios=[1.5, 1], layout="constrained")
    own = [row for row in rows if "specialist_gap" in row]
    own.sort(key=lambda row: (not row["arm"].startswith("locked"), row["seen"], _mean(row)))
    _points(left, range(len(own)), own)
    gaps = [_percent(row["specialist_gap"]) for row in own]
    left.plot(range(len(own)), gaps, "_", color=SPECIALIST, markersize=14, markeredgewidth=2, label="PPO of this arm")
    labels = [row["arm"] + (" (seen)" if row["seen"] else "") for row in own]
    left.set_xticks(range(len(own)), labels, rotation=90, fontsize=8)
    left.set(yscale="log", ylabel="optimality gap [%]", title="Locked joints of the Panda, and real arms")
    left.legend(frameon=False)
    random = [row for row in rows if row["arm"].startswith("random")]
    places = np.array([row["joints"] for row in random]) + np.linspace(-0.25, 0.25, len(random))
    first = 10  # place of the first arm outside of the distribution
    _points(right, [*places, *range(first, first + len(outside))], [*random, *outside])
    right.set_xticks(
        [*range(4, 9), *range(first, first + len(outside))],
        [*(f"{joints} joints" for joints in range(4, 9)), *(row["arm"].replace("_", " ") for row in outside)],
        rotation=90,
        fontsize=8,
    )
    right.axvline(first - 1, color="gray", linewidth=0.5)
    right.set(yscale="log", title="Random arms, and arms outside of their distribution")
    save(figure, out)


def _points(axes: Any, places: Any, rows: Sequence[Mapping[str, Any]]) -> None:
    axes.plot(
        places,
        [_percent(row["controller_gap"]) for row in rows],
        "o",
        color=CONTROLLER,
        label="controller, no training",
    )
    axes.plot(places, [_percent(_mean(row)) for row in rows], ".", color=POLICY, label="one policy for all arms")


def _mean(row: Mapping[str, Any]) -> float:
    return float(np.mean([value for key, value in row.items() if key.startswith("seed_")]))


def _percent(gap: float) -> float:
    return max(100 * gap, FLOOR)


def main() -> None:
    """Runs the command."""
    policy, outside, out = map(Path, sys.argv[1:])
    rows, others = (
        [row for row in json.loads(file.read_text())["arms"] if row["controller_gap"] is not None]
        for file in (policy, outside)
    )
    draw(rows, others, out)


if __name__ == "__main__":
    main()
