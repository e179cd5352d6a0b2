"""A plot of the gap of each arm, for a policy of many arms."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import matplotlib.ticker  # noqa: E402
import numpy as np  # noqa: E402

_TITLES = {True: "seen in training", False: "not seen in training"}
_COLOURS = {True: "tab:blue", False: "tab:orange"}
_LINEAR = 0.1  # %: gaps below it are on a linear axis, as a rollout at the bound has the gap 0
_TICKS = [*(-10.0, -1.0, 0.0), *(digit * 10.0**power for power in range(-1, 4) for digit in (1, 2, 5))]  # %
_ROW, _MARGIN = 0.17, 1.7  # inches


def plot_arms(arms: Mapping[str, Mapping[str, Any]], out: Path, *, controller: str, title: str) -> None:
    """Plots the gap of each arm, the largest first, with that of the controller without learning; not those without.

    Args:
      arms: by name, see `ArmsEvaluator.details`.
      out: the file.
      controller: what the gaps are of.
      title: title of the plot.
    """
    groups = {seen: _sorted(arms, seen) for seen in (True, False)}
    groups = {seen: rows for seen, rows in groups.items() if rows}
    if not groups:
        return
    counts = [len(rows) for rows in groups.values()]
    figure, all_axes = plt.subplots(
        len(groups),
        1,
        figsize=(7, _ROW * sum(counts) + _MARGIN),
        sharex=True,
        squeeze=False,
        layout="constrained",
        height_ratios=counts,
    )
    for axes, (seen, rows) in zip(all_axes[:, 0], groups.items(), strict=True):
        _plot_group(axes, rows, controller, seen)
    last = all_axes[-1, 0]
    last.set_xscale("symlog", linthresh=_LINEAR, linscale=0.5)
    values = [100 * arm[key] for rows in groups.values() for _, arm in rows for key in ("gap", "controller_gap")]
    last.set_xlim(1.3 * min(0, *values) - 0.01, 1.3 * max(_LINEAR, *values))
    last.xaxis.set_major_locator(matplotlib.ticker.FixedLocator(_TICKS))
    last.xaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    last.set_xlabel("optimality gap [%]: 0 is the kinematic bound, 100 is holding the start pose")
    figure.suptitle(f"{title}: {controller}, each arm (and its joints)")
    labelled: dict[str, Any] = {}
    for axes in all_axes[:, 0]:
        labelled |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(labelled.values(), labelled.keys(), loc="outside lower center", ncols=3, fontsize="small")
    figure.savefig(out, dpi=150)
    plt.close(figure)


def _plot_group(axes: Any, rows: Sequence[tuple[str, Mapping[str, Any]]], controller: str, seen: bool) -> None:
    """Plots the arms that were seen, or not, one below the other."""
    place = np.arange(len(rows))
    gap, own = (100 * np.array([arm[key] for _, arm in rows]) for key in ("gap", "controller_gap"))
    axes.hlines(place, np.minimum(gap, own), np.maximum(gap, own), color="lightgrey", lw=1.5, zorder=0)
    axes.plot(own, place, "o", color="grey", mfc="white", markersize=4.5, label="controller without learning")
    axes.plot(gap, place, "o", color=_COLOURS[seen], markersize=4.5, label=f"{controller}, {_TITLES[seen]}")
    axes.set_yticks(place, [f"{name} ({arm['joints']})" for name, arm in rows], fontsize=7)
    axes.set(ylim=(len(rows) - 0.4, -0.6), title=f"{_TITLES[seen]}: {len(rows)}")
    axes.grid(alpha=0.3, axis="x", which="both")


def _sorted(arms: Mapping[str, Mapping[str, Any]], seen: bool) -> list[tuple[str, Mapping[str, Any]]]:
    """The arms that were seen, or not, and have a gap; the largest gap first."""
    rows = [(name, arm) for name, arm in arms.items() if arm["seen"] == seen and np.isfinite(arm["gap"])]
    return sorted(rows, key=lambda row: -row[1]["gap"])
