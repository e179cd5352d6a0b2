"""Pairs per second of the metric's kernel, against the batch and against the links of the arms."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.figures.canvas import plt, save

STYLES = {"value": "o-", "gradient": "s--", "all": "^:"}
LABELS = {"batch": "pairs of Panda poses, 7 and 4 joints", "links": "links of both planar arms"}
BYTES = 4 * (22 + 1)  # read and written for the value of a pair of Pandas: joint angles and velocities, distance


def plot(results: Sequence[dict[str, Any]], limits: dict[str, float], out: Path) -> None:
    figure, panels = plt.subplots(1, len(LABELS), figsize=(11, 4.5), sharey=True, layout="constrained")
    rows = [row for row in results if "pairs_per_s" in row]
    colours = {method: f"C{i}" for i, method in enumerate(dict.fromkeys(row["method"] for row in rows))}
    for axes, (sweep, label) in zip(panels, LABELS.items(), strict=True):
        lines: dict[tuple[str, str], list[tuple[float, float]]] = {}
        for row in rows:
            if row["sweep"] == sweep:
                lines.setdefault((row["method"], row["quantity"]), []).append((row["size"], row["pairs_per_s"]))
        for (method, quantity), points in lines.items():
            style = {"color": colours[method], "markersize": 4, "label": f"{method}, {quantity}"}
            axes.plot(*zip(*points, strict=True), STYLES[quantity], **style)
        axes.set(xscale="log", yscale="log", xlabel=label)
        axes.grid(True, alpha=0.3)
    panels[0].axhline(limits["copy_bytes_per_second"] / BYTES, color="0.5", label="a copy of the same bytes")
    panels[0].set_ylabel("pairs per second")
    panels[0].legend(fontsize="small")
    save(figure, out)
