"""The tables and figures of `benchmarks.dynamic_imitation`, from the reports and tables in its folder."""

import csv
import json
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

_KEPT = (
    "optimality_gap", "mean_distance", "lower_bound", "hold_distance", "link_angle_error_deg", "angular_velocity_error",
    "torque_rms", "torque_change", "torque_saturation", "position_violations", "speed_violations", "torque_violations",
)  # fmt: skip
_SIMULATIONS = ("one_demonstration", "panda7dof", "panda4dof", "panda3dof")
_JOINTS = range(1, 8)


def collect(folder: Path) -> dict[str, Any]:
    """What the reports say, by case: `NAME` of the runs, `NAME--KIND` of their evaluations; a list over seeds."""
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for path in sorted(folder.glob("*/report.json")):
        match = re.fullmatch(r"(.+?)-(\d+)(--.+)?", path.parent.name)
        if not match:
            continue
        report = json.loads(path.read_text())
        entry = {"seed": int(match[2]), **{key: report[key] for key in _KEPT}}
        if not match[3]:
            gap = _history(path.parent)
            entry |= {"best_gap": min(gap), "final_gap": gap[-1], "env_steps": report["env_steps"]}
        entry |= {key: report[key] for key in ("frequency_rad_s", "starts") if report.get(key)}
        if "similarity" in report:
            entry["similarity"] = _rounded(report["similarity"])
        if (path.parent / "quality.csv").is_file() and (match[1] in _SIMULATIONS[:2] and match[2] == "0"):
            entry["curves"] = _curves(path.parent / "quality.csv")
        found[match[1] + (match[3] or "")].append(entry)
    return {name: sorted(entries, key=lambda entry: entry["seed"]) for name, entries in found.items()}


def _rounded(values: Any) -> Any:
    """Nested numbers with four digits behind the point, which is more than the measures mean."""
    return round(values, 4) if isinstance(values, float) else {key: _rounded(value) for key, value in values.items()}


def _history(run: Path) -> list[float]:
    with (run / "metrics.csv").open(newline="") as file:
        return [float(row["quality/optimality_gap.train"]) for row in csv.DictReader(file)]


def _curves(path: Path) -> dict[str, list[float]]:
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row.pop("split") == "held_out"]
    return {key: [round(float(row[key]), 6) for row in rows] for key in rows[0]}


def show(results: dict[str, Any], console: Console) -> None:
    """One table of all cases."""
    table = Table(
        "case", "seeds", "gap, training", "gap, held out", "angle", "torque change", "violations", "late loss"
    )
    for name, entries in results.items():
        late = [entry["final_gap"] - entry["best_gap"] for entry in entries if "final_gap" in entry]
        violations = [
            sum(e[f"{kind}_violations"]["held_out"] for kind in ("position", "speed", "torque")) for e in entries
        ]
        table.add_row(
            name,
            str(len(entries)),
            spread([entry["optimality_gap"]["train"] for entry in entries]),
            spread([entry["optimality_gap"]["held_out"] for entry in entries]),
            f"{np.mean([entry['link_angle_error_deg']['held_out'] for entry in entries]):.1f}",
            f"{np.mean([entry['torque_change']['held_out'] for entry in entries]):.1%}",
            f"{np.mean(violations):.0f}",
            f"{max(late):.2%}" if late else "",
        )
    console.print(table)


def spread(values: list[float]) -> str:
    """Mean, and standard deviation of several, in percent."""
    text = f"{100 * np.mean(values):.2f}"
    return f"{text} ± {100 * np.std(values, ddof=1):.2f} %" if len(values) > 1 else f"{text} %"


def draw(results: dict[str, Any], out: Path) -> None:
    """Figures of what is there: `OUT_unseen.png`, `OUT_controllers.png`, `OUT_locked.png`."""
    if "one_demonstration--unseen" in results and "panda7dof--unseen" in results:
        _draw_unseen(results, out.with_name(out.name + "_unseen.png"))
    if "panda7dof--computed_torque" in results:
        _draw_controllers(results, out.with_name(out.name + "_controllers.png"))
    if all(f"locked-{joint}" in results for joint in _JOINTS):
        _draw_locked(results, out.with_name(out.name + "_locked.png"))


def _draw_unseen(results: dict[str, Any], out: Path) -> None:
    """The paper's figure on its second simulation."""
    figure, axes = plt.subplots(figsize=(6, 3.8), layout="constrained")
    labels = {"one_demonstration": "trained on one demonstration", "panda7dof": "trained on 124"}
    for (name, label), colour in zip(labels.items(), ("tab:orange", "tab:blue"), strict=True):
        curves = results[f"{name}--unseen"][0]["curves"]
        axes.plot(curves["time"], curves["mean"], color=colour, label=label)
        axes.fill_between(curves["time"], curves["low"], curves["high"], color=colour, alpha=0.2, lw=0)
    axes.plot(curves["time"], curves["hold"], ":", color="grey", label="holding still")
    title = "32 unseen demonstrations, 7 to 7 joints: the lower bound is 0"
    axes.set(xlabel="time [s]", ylabel="embodiment distance", title=title, yscale="log", ylim=(1e-5, 1))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    _save(figure, out)


def _draw_controllers(results: dict[str, Any], out: Path) -> None:
    """PPO among what a user would do instead."""
    kinds = {"": "PPO", "--computed_torque": "computed torque", "--pd": "PD"}
    figure, axes = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
    arms = [arm for arm in _SIMULATIONS[1:] if f"{arm}--pd" in results]
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
    _save(figure, out)


def _draw_locked(results: dict[str, Any], out: Path) -> None:
    """Bound and gap for every locked joint (diagonal) and pair."""
    figure, all_axes = plt.subplots(1, 2, figsize=(9.5, 4.2), layout="constrained")
    size = len(_JOINTS)
    bound, gap = np.full((size, size), np.nan), np.full((size, size), np.nan)
    for i in _JOINTS:
        for j in _JOINTS[i - 1 :]:
            name = f"locked-{i}" if i == j else f"locked-{i}-{j}"
            if name in results:
                entry = results[name][0]
                bound[j - 1, i - 1] = entry["lower_bound"]["held_out"]
                gap[j - 1, i - 1] = 100 * entry["optimality_gap"]["held_out"]
    for axes, values, title, form in (
        (all_axes[0], bound, "lower bound of the distance", "{:.3f}"),
        (all_axes[1], gap, "optimality gap of PPO, unseen [%]", "{:.1f}"),
    ):
        picture = axes.imshow(values, cmap="viridis_r" if axes is all_axes[0] else "magma_r")
        for (row, column), value in np.ndenumerate(values):
            if np.isfinite(value):
                dark = value > np.nanmin(values) + 0.6 * (np.nanmax(values) - np.nanmin(values))
                colour = "white" if dark else "black"
                axes.text(column, row, form.format(value), ha="center", va="center", fontsize=7, color=colour)
        axes.set_xticks(range(size), _JOINTS)
        axes.set_yticks(range(size), _JOINTS)
        axes.set(title=title, xlabel="locked joint", ylabel="and joint (diagonal: that one alone)")
        figure.colorbar(picture, ax=axes, shrink=0.8)
    _save(figure, out)


def _save(figure: Any, out: Path) -> None:
    figure.savefig(out, dpi=150, bbox_inches="tight")
    plt.close(figure)
