"""A plot of the arms of a pose mapper to any arm: how far each is above the optimum."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import matplotlib.ticker  # noqa: E402
import numpy as np  # noqa: E402

_TITLES = {True: "arms seen in training", False: "unseen arms"}
_FLOOR = 0.01  # per cent: smaller values are drawn here
_INCHES, _MIN_INCHES = 0.17, 3.0  # width of a column and of a part


def plot_mapper_arms(table: Mapping[str, Mapping[str, Any]], out: Path, guesses: int, *, title: str) -> None:
    """Plots how far each arm is above the optimum: by the mapper, its proposals, and Newton steps without a network.

    Args:
      table: metrics of each arm by its name, and whether it was `seen` in training, see `AnyArmMapperTrainer`.
      out: file of the plot.
      guesses: number of random guesses that the mapper is compared with.
      title: of the plot.
    """
    series = {  # label, marker, colour
        "quality_from_home": ("Newton steps from home", "v", "tab:green"),
        "quality_random_guesses": (f"Newton steps from {guesses} random guesses", "^", "tab:orange"),
        "quality_proposed": ("the network's proposals, without Newton steps", "o", "lightsteelblue"),
        "quality": ("mapper", "o", "tab:blue"),
    }
    by_quality = sorted(table, key=lambda name: table[name]["quality"])
    groups = {seen: [name for name in by_quality if table[name]["seen"] == seen] for seen in (True, False)}
    parts = {seen: names for seen, names in groups.items() if names}
    widths = [max(_INCHES * len(names), _MIN_INCHES) for names in parts.values()]
    figure, all_axes = plt.subplots(
        1, len(parts), figsize=(sum(widths) + 1, 4.5), sharey=True, layout="constrained", squeeze=False,
        width_ratios=widths,
    )  # fmt: skip
    for axes, (seen, names) in zip(all_axes[0], parts.items(), strict=True):
        for key, (label, marker, colour) in series.items():
            percent = np.maximum([100 * table[name][key] for name in names], _FLOOR)
            axes.plot(range(len(names)), percent, marker, color=colour, label=label, markersize=5)
        axes.set(title=_TITLES[seen], yscale="log", xlim=(-0.7, len(names) - 0.3))
        axes.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
        axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        axes.grid(alpha=0.3)
    all_axes[0, 0].set(ylabel="above the optimum [%]\n(0 best, 100 a random pose)")
    figure.suptitle(title)
    handles, labels = all_axes[0, 0].get_legend_handles_labels()
    figure.legend(handles[::-1], labels[::-1], loc="outside lower center", ncols=2, fontsize=8)
    figure.savefig(out, dpi=150)
    plt.close(figure)
