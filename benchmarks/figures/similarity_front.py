"""The rows of `benchmarks.similarity`: ratios to a baseline, cases lost, the Pareto front, tables and figure."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.record import Row, print_table
from benchmarks.figures.canvas import plt, save
from mimic.metric.similarity import MEASURES
from mimic.retargeting.pose_baselines import BASELINES

FRONT = ("centre_line_distance", "tangent_angle_deg", "hand_position_error", "hand_angle_deg")  # a candidate's aims
SLACK = {"hand_position_error": 1.05}  # multiple of the baseline's value that is no loss; 1 for the others
# Below these a baseline is exact (a locked last roll joint moves no link): no ratio, and reaching them is no loss.
POSTURE = "elbow", "wrist", "plane_deg"  # of `benchmarks.exact_hands.posture`, in the rows of weights of the hand
EXACT = {name: 0.1 if name.endswith("deg") else 1e-3 for name in (*MEASURES, *POSTURE)}
NO_HAND = "hand 0"  # the default metric without a weight of the hand
DEMONSTRATIONS = "computed_torque", "reach"


def measure_names(rows: Sequence[Row]) -> list[str]:
    """Names of the measures of some rows."""
    return list(next((row["measures"] for row in rows if "measures" in row), {}))


def is_lock(row: Row) -> bool:
    """Whether a row is of a Panda with one or two joints locked: the 28 that the default is chosen on."""
    return row["pair"].startswith("panda -") and row["pair"].count(",") <= 1


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """`compare` for the locks and for the other arms."""
    locks, others = [*filter(is_lock, rows)], [row for row in rows if " to " in row["pair"]]
    summary = {"locks, demonstrations, to copy_joints": compare(locks, "copy_joints")}
    if any(row.get("method") == NO_HAND for row in rows):
        summary["locks, demonstrations, to no weight"] = compare(locks, NO_HAND)
        summary["other arms, demonstrations, to no weight"] = compare(others, NO_HAND)
    return {**summary, "other arms, demonstrations, to hand_ik": compare(others, "hand_ik")}


def compare(rows: Sequence[Row], baseline: str) -> dict[str, dict[str, Any]]:
    """By method run on all cases: ratio of each measure to a baseline's (geometric mean), cases lost, and cases."""
    chosen = [row for row in rows if "failed" not in row]
    cases: dict[tuple[str, str], dict[str, dict[str, float]]] = {}
    for row in chosen:
        cases.setdefault((row["pair"], row["set"]), {})[row["method"]] = row["measures"]
    result: dict[str, dict[str, Any]] = {}
    for method in dict.fromkeys(row["method"] for row in chosen):
        if all({method, baseline} <= set(case) for case in cases.values()):
            result[method] = {"cases": len(cases)}
            for name in measure_names(chosen):
                values = [(case[method][name], case[baseline][name]) for case in cases.values()]
                ratios = [np.log(max(own, EXACT[name]) / other) for own, other in values if other > EXACT[name]]
                lost = sum(own > max(SLACK.get(name, 1.0) * other, EXACT[name]) for own, other in values)
                ratio = round(float(np.exp(np.mean(ratios))), 4) if ratios else None
                result[method][name] = {"ratio": ratio, "lost": int(lost)}
    return result


def pareto_front(compared: dict[str, dict[str, Any]]) -> list[str]:
    """Candidates that no other beats on one measure of `FRONT` and equals on the rest."""
    ratios = {
        method: np.array([result[name]["ratio"] for name in FRONT])
        for method, result in compared.items()
        if method not in BASELINES and all(result[name]["ratio"] is not None for name in FRONT)
    }
    others = ratios.values()
    return [key for key, own in ratios.items() if not any(np.all(x <= own) and np.any(x < own) for x in others)]


def print_tables(rows: Sequence[Row]) -> None:
    names = measure_names(rows)
    columns = " ".join(["method", *(f"{name}[{entry}]" for name in names for entry in ("ratio", "lost")), "front"])
    for title, compared in summarise(rows).items():
        front = pareto_front(compared)
        table = [{"method": key, **result, "front": "*" * (key in front)} for key, result in compared.items()]
        print_table(table, columns, title)


def plot(rows: Sequence[Row], path: Path) -> None:
    """The candidates on the 28 locked Pandas relative to copying: the whole arm on the left, the hand on the right."""
    compared = compare([*filter(is_lock, rows)], "copy_joints")
    front = pareto_front(compared)
    families: dict[str, list[str]] = {}
    for method in compared:
        families.setdefault(method if method in BASELINES else method.rpartition(" ")[0], []).append(method)
    figure, panels = plt.subplots(1, 2, figsize=(10.5, 4.6), layout="constrained")
    for axes, names in zip(panels, (FRONT[:2], FRONT[2:]), strict=True):
        for family, methods in families.items():
            points = [[compared[method][name]["ratio"] for name in names] for method in methods]
            (line,) = axes.plot(*np.transpose(points), lw=1, label=family.replace("_", " "))
            for method, point in zip(methods, points, strict=True):
                fill = line.get_color() if method in front else "white"
                axes.plot(*point, "s" if method in BASELINES else "o", ms=7, color=line.get_color(), mfc=fill)
                weight = "" if method in BASELINES else method.rpartition(" ")[2]
                axes.annotate(weight, point, xytext=(5, 5), textcoords="offset points", fontsize=8)
        axes.set(xlim=(0, 1.5), ylim=(0, 1.5), xlabel=f"{names[0]}, relative to copying", ylabel=names[1])
        axes.grid(alpha=0.25)
    panels[0].legend(fontsize=8)
    figure.suptitle(
        "28 locked Pandas, computed torque and reach; numbers: translation weight; filled: Pareto front", fontsize=10
    )
    save(figure, path)


def plot_hands(rows: Sequence[Row], path: Path) -> None:
    """Rotation of the hand against the centre line for each weight, relative to none: the price of the hand."""
    figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    groups = {
        "Panda with one or two joints locked": [*filter(is_lock, rows)],
        "Panda and other arms": [r for r in rows if " to " in r["pair"]],
    }
    for label, group in groups.items():
        compared = compare(group, NO_HAND)
        points = {name: result for name, result in compared.items() if name.startswith("hand ")}
        values = [
            [result[name]["ratio"] for name in ("centre_line_distance", "hand_rotation_deg")]
            for result in points.values()
        ]
        if values:
            axes.plot(*np.transpose(np.array(values, float)), "o-", label=label)
            for name, point in list(zip(points, values, strict=True))[-4:]:
                axes.annotate(
                    name.removeprefix("hand "), tuple(point), xytext=(5, 5), textcoords="offset points", fontsize=8
                )
    axes.axvline(1.05, color="0.6", lw=1, ls="--")
    axes.set(
        xlabel="centre line distance, relative to no weight", ylabel="hand rotation, relative to no weight", ylim=0
    )
    axes.grid(alpha=0.25)
    axes.legend(fontsize=9)
    save(figure, path)
