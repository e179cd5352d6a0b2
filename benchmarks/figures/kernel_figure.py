"""Pairs per second of the metric's kernel, against the batch and against the links of the arms."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

STYLES = {"value": "o-", "gradient": "s--", "all": "^:"}
LABELS = {"batch": "pairs of Panda poses, 7 and 4 joints", "links": "links of both planar arms"}
BYTES = 4 * (22 + 1)  # that a pair of Pandas must move for its value: joint angles and velocities, and the distance


def plot(results: Sequence[dict[str, Any]], limits: dict[str, float], out: Path) -> None:
    """One panel for each sweep."""
    figure, panels = plt.subplots(1, len(LABELS), figsize=(11, 4.5), sharey=True, layout="constrained")
    measured = [row for row in results if "pairs_per_s" in row]
    methods = list(dict.fromkeys(row["method"] for row in measured))
    for axes, (sweep, label) in zip(panels, LABELS.items(), strict=True):
        for index, method in enumerate(methods):
            for quantity, style in STYLES.items():
                chosen = (sweep, method, quantity)
                rows = [row for row in measured if (row["sweep"], row["method"], row["quantity"]) == chosen]
                sizes, speeds = [row["size"] for row in rows], [row["pairs_per_s"] for row in rows]
                if rows:
                    axes.plot(sizes, speeds, style, color=f"C{index}", markersize=4, label=f"{method}, {quantity}")
        axes.set(xscale="log", yscale="log", xlabel=label)
        axes.grid(True, alpha=0.3)
    panels[0].axhline(limits["copy_bytes_per_second"] / BYTES, color="0.5", label="a copy of the same bytes")
    panels[0].set_ylabel("pairs per second")
    panels[0].legend(fontsize="small")
    figure.savefig(out, dpi=150)
    plt.close(figure)
