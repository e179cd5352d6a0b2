"""Plot of collected runs: learning curves of their groups, and their final values."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.ticker
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mimic.commands.collect.finished_runs import QualityMetric
from mimic.commands.collect.seed_groups import SeedGroup, mean_interval
from mimic.evaluation.labels import SPLITS

_LABELS = {"train": "training data", "held_out": "held-out data"}
_MARKERS = {"train": "s", "held_out": "o"}
_TICK_WIDTH = 26  # characters
_SMALL = 1e-6  # [%], for a logarithmic axis
_TABLEAU = 10  # number of distinct colours; more groups use a colour map


def plot_collected(groups: Sequence[SeedGroup], metric: QualityMetric, out: Path) -> None:
    """Plots held-out learning curves and the final metric of each group in percent, with confidence intervals."""
    height = max(4.0, 1.6 + 0.42 * len(groups))
    figure = Figure(figsize=(11, height), layout="constrained")
    curves, final = figure.subplots(1, 2)
    colours = [_colour(number, len(groups)) for number in range(len(groups))]
    for group, colour in zip(groups, colours, strict=True):
        _draw_curves(curves, group, colour)
    percent = matplotlib.ticker.FormatStrFormatter("%g")
    curves.set(xlabel=metric.unit.replace("_", " "), ylabel=f"{metric.label} [%]", yscale="log")
    curves.set_title("held-out data while training: seeds, mean, 95 % interval", fontsize="medium")
    curves.yaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
    curves.yaxis.set_major_formatter(percent)
    curves.yaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
    shown = [100 * x for group in groups for run in group.runs for x in run.curves["held_out"].values() if x > 0]
    curves.set_ylim(bottom=0.7 * min(shown) if shown else None)  # bands below 0 are cut off
    for row, (group, colour) in enumerate(zip(groups, colours, strict=True)):
        _draw_final(final, group, metric, row, colour)
    final.set_yticks(range(len(groups)), [_tick(group) for group in groups])
    final.set(xlabel=f"{metric.label} [%]", xlim=(min(0, final.get_xlim()[0]), None), ylim=(len(groups) - 0.5, -0.5))
    final.set_title("at the end: seeds (ticks), mean, 95 % interval", fontsize="medium")
    marks = [Line2D([], [], color="grey", marker=_MARKERS[split], mfc=_fill(split, "grey"), ls="") for split in SPLITS]
    figure.legend(marks, [_LABELS[split] for split in SPLITS], fontsize="small", loc="outside lower right", ncols=2)
    for axes in (curves, final):
        axes.grid(alpha=0.3, which="major")
    figure.savefig(out, dpi=150)


def _tick(group: SeedGroup) -> str:
    return f"{textwrap.fill(group.label, _TICK_WIDTH)}\n{len(group.runs)} seed{'s' * (len(group.runs) > 1)}"


def _fill(split: str, colour: Any) -> Any:
    return "white" if split == "train" else colour


def _colour(number: int, count: int) -> Any:
    maps = matplotlib.colormaps
    return maps["tab10"](number) if count <= _TABLEAU else maps["turbo"](number / (count - 1))


def _draw_curves(axes: Any, group: SeedGroup, colour: Any) -> None:
    """Draws each seed as a faint line, and mean and band at the steps that all seeds have reached."""
    by_seed = [run.curves["held_out"] for run in group.runs]
    for curve in by_seed:
        axes.plot(list(curve), [100 * value for value in curve.values()], color=colour, alpha=0.3, lw=0.8)
    steps = sorted(set(by_seed[0]).intersection(*by_seed))
    intervals = [mean_interval([100 * curve[step] for curve in by_seed]) for step in steps]
    axes.plot(steps, [interval.mean for interval in intervals], color=colour, lw=1.8, label=group.label)
    if steps and intervals[0].low is not None:
        low, high = ([getattr(interval, end) for interval in intervals] for end in ("low", "high"))
        axes.fill_between(steps, np.maximum(low, _SMALL), high, color=colour, alpha=0.15, lw=0)


def _draw_final(axes: Any, group: SeedGroup, metric: QualityMetric, row: int, colour: Any) -> None:
    for split, shift in zip(SPLITS, (-0.15, 0.15), strict=True):
        key = f"{metric.key}.{split}"
        interval = group.interval(key)
        half = [0.0 if interval.high is None else 100 * (interval.high - interval.mean)]
        seeds = [100 * run.numbers[key] for run in group.runs]
        axes.plot(seeds, [row + shift] * len(seeds), "|", color="black", markersize=9, zorder=3)
        axes.errorbar([100 * interval.mean], [row + shift], xerr=[half, half], color=colour, marker=_MARKERS[split],
                      mfc=_fill(split, colour), capsize=3, markersize=6, lw=1.5)  # fmt: skip
