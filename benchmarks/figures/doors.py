"""How far the door opens in the replays of `benchmarks.transfer`, and how far the hand lags behind its target.

python -m benchmarks.figures.doors WORK --out docs/images
"""

import json
from pathlib import Path

import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.figures.canvas import plt
from benchmarks.transfer import ARMS

_DT, _OPEN = 0.05, 0.3  # s; rad, from which robosuite counts the door as open
_FROM = 9.0  # s: the hand arrives at the handle


def plot_doors(work: Path, out: Path) -> None:
    """Plots the replays of doors that are in a working folder of the benchmark."""
    names = [("panda", "recorded"), *((arm, "mimic") for arm in ARMS)]
    figure, axes = plt.subplots(1, 2, figsize=(9, 2.8), layout="constrained")
    for name, method in names:
        (result,) = json.loads((work / f"replays_door_{name}_{method}.json").read_text())
        for axis, key in zip(axes, ("door_rad", "hand_lag_mm"), strict=True):
            values, style = np.array(result[key]), "-" if result["success"] else "--"
            axis.plot(_DT * np.arange(1, len(values) + 1), values, style, lw=1.2, label=name)
    axes[0].axhline(_OPEN, color="black", lw=0.8, ls=":")
    for axis, label in zip(axes, ("door [rad]", "hand behind its target [mm]"), strict=True):
        axis.set(xlabel="time [s]", ylabel=label, xlim=(_FROM, None))
        axis.grid(alpha=0.3)
    axes[1].set_ylim(0, 60)  # the Jaco goes on to 86
    axes[0].legend(fontsize=8, loc="upper left")
    figure.savefig(out / "doors.png", dpi=100)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser("figures.doors", __doc__, out="DIR")
    parser.add_argument("work", type=Path)
    options = parser.parse_args(arguments)
    plot_doors(options.work, options.out)


if __name__ == "__main__":
    main()
