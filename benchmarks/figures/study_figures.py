"""Figures of `benchmarks.dynamic_imitation`."""

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures.canvas import plt, save

CURVES = ("one_demonstration", "panda7dof")  # cases whose distance is drawn over time
_ARMS = ("panda7dof", "panda4dof", "panda3dof")
_JOINTS = range(1, 8)
Study = dict[str, list[dict[str, Any]]]


def draw(results: Study, out: Path) -> None:
    """The figures that there are results for: `OUT_unseen.png`, `OUT_controllers.png`, `OUT_locked.png`."""
    if all(f"{case}--unseen" in results for case in CURVES):
        _draw_unseen(results, out.with_name(out.name + "_unseen.png"))
    if "panda7dof--computed_torque" in results:
        _draw_controllers(results, out.with_name(out.name + "_controllers.png"))
    if all(f"locked-{joint}" in results for joint in _JOINTS):
        _draw_locked(results, out.with_name(out.name + "_locked.png"))


def _draw_unseen(results: Study, out: Path) -> None:
    figure, axes = plt.subplots(figsize=(6, 3.8), layout="constrained")
    labels = "trained on one demonstration", "trained on 124"
    curves: dict[str, Any] = {}
    for case, label, colour in zip(CURVES, labels, ("tab:orange", "tab:blue"), strict=True):
        curves = results[f"{case}--unseen"][0]["curves"]
        axes.plot(curves["time"], curves["mean"], color=colour, label=label)
        axes.fill_between(curves["time"], curves["low"], curves["high"], color=colour, alpha=0.2, lw=0)
    axes.plot(curves["time"], curves["hold"], ":", color="grey", label="holding the start pose")
    title = "32 unseen demonstrations, 7 to 7 joints: kinematic bound 0"
    axes.set(xlabel="time [s]", ylabel="embodiment distance", title=title, yscale="log", ylim=(1e-5, 1))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    save(figure, out)


def _draw_controllers(results: Study, out: Path) -> None:
    kinds = {"": "PPO", "--computed_torque": "computed torque", "--pd": "PD"}
    figure, axes = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
    arms = [arm for arm in _ARMS if f"{arm}--pd" in results]
    for place, (kind, label) in enumerate(kinds.items()):
        seeds = [[100 * entry["optimality_gap"]["held_out"] for entry in results[arm + kind]] for arm in arms]
        middle = np.arange(len(arms)) + 0.27 * (place - 1)
        axes.bar(middle, [np.mean(gaps) for gaps in seeds], 0.25, label=label, zorder=2)
        for x, gaps in zip(middle, seeds, strict=True):
            if len(gaps) > 1:
                axes.plot(np.full(len(gaps), x), gaps, "k.", ms=4, zorder=3)
            axes.text(x, max(gaps) + 0.08, f"{np.mean(gaps):.1f}", ha="center", fontsize=8)
    axes.set_xticks(range(len(arms)), [f"7 to {arm[5]} joints" for arm in arms])
    axes.set(ylabel="optimality gap, unseen [%]", title="mean of the seeds (dots)")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3, axis="y")
    save(figure, out)


def _draw_locked(results: Study, out: Path) -> None:
    figure, (bounds, gaps) = plt.subplots(1, 2, figsize=(9.5, 4.2), layout="constrained")
    panels = (
        (bounds, "lower_bound", 1, "kinematic bound of the distance", "{:.3f}", "viridis_r"),
        (gaps, "optimality_gap", 100, "optimality gap of PPO, unseen [%]", "{:.1f}", "magma_r"),
    )
    for axes, entry, factor, title, form, colours in panels:
        values = np.full((len(_JOINTS), len(_JOINTS)), np.nan)
        for i in _JOINTS:
            for j in _JOINTS[i - 1 :]:
                name = f"locked-{i}" if i == j else f"locked-{i}-{j}"
                if name in results:
                    values[j - 1, i - 1] = factor * results[name][0][entry]["held_out"]
        picture = axes.imshow(values, cmap=colours)
        for (row, column), value in np.ndenumerate(values):
            if np.isfinite(value):
                dark = value > np.nanmin(values) + 0.6 * (np.nanmax(values) - np.nanmin(values))
                colour = "white" if dark else "black"
                axes.text(column, row, form.format(value), ha="center", va="center", fontsize=7, color=colour)
        for set_ticks in (axes.set_xticks, axes.set_yticks):
            set_ticks(range(len(_JOINTS)), _JOINTS)
        axes.set(title=title, xlabel="locked joint", ylabel="and joint (diagonal: that one alone)")
        figure.colorbar(picture, ax=axes, shrink=0.8)
    save(figure, out)
