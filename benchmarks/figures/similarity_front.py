"""What the rows of `benchmarks.similarity` say: ratios to a baseline, cases lost, and the Pareto front."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from mimic.metric.similarity import MEASURES
from mimic.retargeting.pose_baselines import BASELINES

Rows = list[dict[str, Any]]

FRONT = ("centre_line_distance", "tangent_angle_deg", "hand_position_error", "hand_angle_deg")  # a candidate's aims
SLACK = {"hand_position_error": 1.05}  # how many times the baseline's value is no loss; 1 for the others
# Below these a baseline is exact (a locked last roll joint moves no link): no ratio, and reaching them is no loss.
EXACT = {name: 0.1 if name.endswith("deg") else 1e-3 for name in MEASURES}
SHORT = dict(zip(MEASURES, ("centre line", "tangents", "Frechet", "hand pos.", "hand dir."), strict=True))
DEMONSTRATIONS = "pd", "reach"


def to_lines(rows: Rows) -> list[str]:
    """Rows as lines of a table, which take a quarter of the space of nested JSON; the first names the columns.

    Each measure has its mean and 90 % quantile; a set of poses that could not be made has the reason as its method.
    """
    columns = [f"{name}{suffix}" for name in MEASURES for suffix in ("", " q90")]
    lines = [";".join(["pair", "set", "poses", "method", *columns])]
    for row in rows:
        values = [] if "failed" in row else [f"{value:g}" for name in MEASURES for value in row["measures"][name]]
        words = [row["pair"], row["set"], str(row.get("poses", 0)), row.get("failed", row.get("method"))]
        lines.append(";".join([*words, *values]))
    return lines


def from_lines(lines: Sequence[str]) -> Rows:
    """The rows that `to_lines` wrote."""
    rows = []
    for line in lines[1:]:
        pair, poses_set, poses, method, *numbers = line.split(";")
        if numbers:
            values = list(map(float, numbers))
            measures = {name: values[2 * i : 2 * i + 2] for i, name in enumerate(MEASURES)}
            rows.append({"pair": pair, "set": poses_set, "poses": int(poses), "method": method, "measures": measures})
        else:
            rows.append({"pair": pair, "set": poses_set, "failed": method})
    return rows


def is_lock(row: dict[str, Any]) -> bool:
    """Of a Panda with one or two joints locked: the 28 that a default is chosen on."""
    return row["pair"].startswith("panda -") and row["pair"].count(",") <= 1


def is_other(row: dict[str, Any]) -> bool:
    """Of two arms of different kinematics."""
    return " to " in row["pair"]


def summarise(rows: Rows) -> dict[str, Any]:
    """Geometric means of the ratios to a baseline and cases lost: of the locks and of the other arms, by method."""
    return {
        "locks, demonstrations, to copy_joints": compare(rows, is_lock, "copy_joints", DEMONSTRATIONS),
        "locks, random poses, to copy_joints": compare(rows, is_lock, "copy_joints", ("random",)),
        "other arms, demonstrations, to hand_ik": compare(rows, is_other, "hand_ik", DEMONSTRATIONS),
        "other arms, random poses, to hand_ik": compare(rows, is_other, "hand_ik", ("random",)),
    }


def compare(
    rows: Rows, select: Callable[[dict[str, Any]], bool], baseline: str, sets: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """By method: ratio of each measure to a baseline's (geometric mean over the cases), cases lost, and cases.

    Methods that were not run on all cases are left out.
    """
    chosen = [row for row in rows if "failed" not in row and row["set"] in sets and select(row)]
    cases = {(row["pair"], row["set"]): {} for row in chosen}
    for row in chosen:
        cases[row["pair"], row["set"]][row["method"]] = {name: v[0] for name, v in row["measures"].items()}
    methods = dict.fromkeys(row["method"] for row in chosen)
    result = {}
    for method in methods:
        if any(method not in case or baseline not in case for case in cases.values()):
            continue
        result[method] = {"cases": len(cases)}
        for name in MEASURES:
            values = [(case[method][name], case[baseline][name]) for case in cases.values()]
            ratios = [np.log(max(own, EXACT[name]) / other) for own, other in values if other > EXACT[name]]
            lost = sum(own > max(SLACK.get(name, 1.0) * other, EXACT[name]) for own, other in values)
            ratio = float(np.exp(np.mean(ratios))) if ratios else None
            result[method][name] = {"ratio": None if ratio is None else round(ratio, 4), "lost": int(lost)}
    return result


def pareto_front(compared: dict[str, dict[str, Any]]) -> list[str]:
    """Candidates that no other beats on one of `FRONT` and equals on the rest."""
    ratios = {
        method: np.array([result[name]["ratio"] for name in FRONT])
        for method, result in compared.items()
        if method not in BASELINES and all(result[name]["ratio"] is not None for name in FRONT)
    }

    def is_beaten(own: np.ndarray) -> bool:
        return any(np.all(other <= own) and np.any(other < own) for other in ratios.values())

    return [method for method, own in ratios.items() if not is_beaten(own)]


def print_tables(rows: Rows) -> None:
    """The tables for a terminal."""
    console = Console(width=120)
    for title, compared in summarise(rows).items():
        front = pareto_front(compared)
        table = Table("method", *SHORT.values(), "front", title=f"{title}: ratio (cases lost)")
        cases = 0
        for method, result in compared.items():
            cases = result["cases"]
            cells = [
                "-" if result[name]["ratio"] is None else f"{result[name]['ratio']:.3f} ({result[name]['lost']})"
                for name in MEASURES
            ]
            table.add_row(method, *cells, "*" if method in front else "")
        if cases:
            table.caption = f"{cases} cases"
            console.print(table)
    for pair, poses in (("panda -3,6,7", "pd"), ("panda -3,6,7", "reach"), ("panda -2,3,6,7", "pd")):
        table = Table("method", *SHORT.values(), title=f"{pair}, {poses}: mean (90 % quantile)")
        for row in rows:
            if row["pair"] == pair and row["set"] == poses and "failed" not in row:
                table.add_row(row["method"], *(f"{m:.3f} ({q:.3f})" for m, q in row["measures"].values()))
        if table.row_count:
            console.print(table)


def save_plot(rows: Rows, path: Path) -> None:
    """The candidates on the 28 locked Pandas relative to copying: the whole arm on the left, the hand on the right."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    compared = compare(rows, is_lock, "copy_joints", DEMONSTRATIONS)
    front = pareto_front(compared)
    figure, panels = plt.subplots(1, 2, figsize=(10.5, 4.6), layout="constrained")
    axes_of = ((FRONT[0], FRONT[1]), (FRONT[2], FRONT[3]))
    families: dict[str, list[str]] = {}
    for method in compared:
        if method not in BASELINES:
            families.setdefault(method.rsplit(" ", 1)[0], []).append(method)
    # Labels of the family that is nearest to the origin go below its points, where no other line is.
    for axes, (x, y), below in zip(panels, axes_of, ("kept arc_length", "kept overlap"), strict=True):
        for family, methods in families.items():
            points = np.array([[compared[method][name]["ratio"] for name in (x, y)] for method in methods])
            (line,) = axes.plot(*points.T, "-", lw=1, label=family.replace("_", " "))
            for method, point in zip(methods, points, strict=True):
                on_front = method in front
                fill = line.get_color() if on_front else "white"
                axes.plot(*point, "o", ms=7, color=line.get_color(), mfc=fill)
                _label(axes, method.rsplit(" ", 1)[1], point, line.get_color(), below=family == below)
        for method, (marker, label) in _REFERENCES.items():
            if method in compared:
                point = [compared[method][name]["ratio"] for name in (x, y)]
                axes.plot(*point, marker, color="grey", label=label)
        axes.plot(1, 1, "X", color="black", ms=9, label="copy joints")
        axes.axvline(1, color="black", lw=0.5, ls=":")
        axes.axhline(1, color="black", lw=0.5, ls=":")
        axes.set(xlabel=f"{_AXIS[x]}, relative to copying joints", ylabel=f"{_AXIS[y]}, relative to copying joints")
        axes.grid(alpha=0.25)
    panels[0].legend(fontsize=8)
    figure.suptitle(
        "28 locked Pandas, pd and reach demonstrations; numbers: translation weight; filled: Pareto front", fontsize=10
    )
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _label(axes: Any, weight: str, point: np.ndarray, colour: str, *, below: bool) -> None:
    """The translation weight beside a point."""
    offset, align = ((-5, -5), ("right", "top")) if below else ((5, 5), ("left", "bottom"))
    style: dict[str, Any] = {"textcoords": "offset points", "fontsize": 8, "color": colour}
    axes.annotate(weight, point, xytext=offset, ha=align[0], va=align[1], **style)


_REFERENCES = {"align_segments": ("s", "align segments"), "hand_ik": ("D", "hand IK")}
_AXIS = {
    "centre_line_distance": "centre-line distance",
    "tangent_angle_deg": "tangent angle",
    "hand_position_error": "hand position error",
    "hand_angle_deg": "hand direction error",
}
