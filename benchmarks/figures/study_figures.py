"""Figures of `benchmarks.study`."""

from pathlib import Path

import numpy as np

from benchmarks.common.record import Row
from benchmarks.figures.canvas import plt, save

CURVES = {"one_demonstration": "trained on one demonstration", "panda7dof": "trained on 124"}  # drawn over time
_ARMS = ("panda7dof", "panda4dof", "panda3dof")
_CONTROLLERS = {"": "PPO", "--computed_torque": "computed torque", "--pd": "PD"}
_JOINTS = range(1, 8)
Study = dict[str, list[Row]]


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
    for (case, label), colour in zip(CURVES.items(), ("tab:orange", "tab:blue"), strict=True):
        curves = results[f"{case}--unseen"][0]["curves"]
        axes.plot(curves["time"], curves["mean"], color=colour, label=label)
        axes.fill_between(curves["time"], curves["low"], curves["high"], color=colour, alpha=0.2, lw=0)
        if case == "panda7dof":
            axes.plot(curves["time"], curves["hold"], ":", color="grey", label="holding the start pose")
    title = "32 unseen demonstrations, 7 to 7 joints: kinematic bound 0"
    axes.set(xlabel="time [s]", ylabel="embodiment distance", title=title, yscale="log", ylim=(1e-5, 1))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    save(figure, out)


def _draw_controllers(results: Study, out: Path) -> None:
    figure, axes = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
    arms = [arm for arm in _ARMS if f"{arm}--pd" in results]
    for place, (controller, label) in enumerate(_CONTROLLERS.items()):
        seeds = [[100 * entry["optimality_gap"]["held_out"] for entry in results[arm + controller]] for arm in arms]
        middle = np.arange(len(arms)) + 0.27 * (place - 1)
        bars = axes.bar(middle, [np.mean(gaps) for gaps in seeds], 0.25, label=label, zorder=2)
        axes.bar_label(bars, fmt="%.1f", padding=4, fontsize=8)
        for x, gaps in zip(middle, seeds, strict=True):
            axes.plot([x] * len(gaps), gaps, "k." if len(gaps) > 1 else "", ms=4, zorder=3)
    axes.set_xticks(range(len(arms)), [f"7 to {arm[5]} joints" for arm in arms])
    axes.set(ylabel="optimality gap, unseen [%]", title="mean of the seeds (dots)")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3, axis="y")
    save(figure, out)


def _draw_locked(results: Study, out: Path) -> None:
    """Bound and gap for every locked joint (diagonal) and pair."""
    figure, (bounds, gaps) = plt.subplots(1, 2, figsize=(9.5, 4.2), layout="constrained")
    panels = (
        (bounds, "lower_bound", 1, "kinematic bound of the distance", "{:.3f}", "viridis_r"),
        (gaps, "optimality_gap", 100, "optimality gap of PPO, unseen [%]", "{:.1f}", "magma_r"),
    )
    for axes, entry, factor, title, form, colours in panels:
        values = np.full((len(_JOINTS), len(_JOINTS)), np.nan)
        for i in _JOINTS:
            for j in _JOINTS[i - 1 :]:
                (run,) = results.get(f"locked-{i}" if i == j else f"locked-{i}-{j}", [{}])
                values[j - 1, i - 1] = factor * run.get(entry, {}).get("held_out", np.nan)
        picture = axes.imshow(values, cmap=colours)
        for (row, column), value in np.ndenumerate(values):
            if np.isfinite(value):
                colour = "white" if picture.norm(value) > 0.6 else "black"
                axes.text(column, row, form.format(value), ha="center", va="center", fontsize=7, color=colour)
        axes.set(title=title, xlabel="locked joint", ylabel="and joint (diagonal: that one alone)")
        for set_ticks in (axes.set_xticks, axes.set_yticks):
            set_ticks(range(len(_JOINTS)), _JOINTS)
        figure.colorbar(picture, ax=axes, shrink=0.8)
    save(figure, out)
