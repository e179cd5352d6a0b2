"""The progress bar of a training, and the tables of a report."""

import math
import os
import time
from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mimic.evaluation.labels import SIMILARITY_HEADERS, SIMILARITY_NAMES, SPLIT_NAMES
from mimic.trainers.trainer import Trainer

_GAP = "  "  # between texts of a line
_REFRESHES = 2  # of a bar in a second: its clocks show whole seconds
_LONGEST_BAR = 40  # columns


class TrainingProgress:
    """A bar with metrics, steps/s, elapsed and remaining time; without a terminal, one line for each evaluation."""

    def __init__(self, console: Console, total_steps: int, done_steps: int = 0):
        self._console, self._total, self._done, self._status = console, total_steps, done_steps, "compiling"
        self._began = self._updated = time.monotonic()
        self._left: float | None = None
        self._live: Live | None = None

    def __enter__(self) -> "TrainingProgress":
        if is_animated(self._console):
            self._live = Live(get_renderable=self._lines, console=self._console, refresh_per_second=_REFRESHES)
            self._live.start()
        else:
            self._console.print(self._status, highlight=False)  # for a minute
        return self

    def __exit__(self, *_: Any) -> None:
        if self._live is not None:
            self._live.stop()

    def update(self, step: int, status: str, steps_per_second: float | None) -> None:
        """Shows the state after an evaluation at a step."""
        self._left = None
        if steps_per_second:
            status += f"{_GAP}{steps_per_second:,.0f} steps/s"
            self._left = max(self._total - step, 0) / steps_per_second
        self._done, self._status, self._updated = min(step, self._total), status, time.monotonic()
        if self._live is not None:
            self._live.refresh()
        else:
            line = _GAP.join([f"step {step:>11,}", self._status, *self._times()])
            self._console.print(line, soft_wrap=True, highlight=False)

    def _times(self) -> list[str]:
        now = time.monotonic()
        left = [] if self._left is None else [f"left {_duration(self._left - (now - self._updated))}"]
        return [f"elapsed {_duration(now - self._began)}", *left]

    def _lines(self) -> Group:
        bar = Table.grid()
        fraction = self._done / max(self._total, 1)
        bar.add_row(ProgressBar(total=1.0, completed=fraction, width=min(self._console.width, _LONGEST_BAR)))
        texts = ["training", f"{self._done:,}/{self._total:,}", *self._times(), self._status]
        return Group(bar, Text(_GAP.join(texts)))


def is_animated(console: Console) -> bool:
    """Whether a bar can be redrawn: on a terminal, but not in the output of a notebook's cell, which keeps every frame.

    Notebooks set FORCE_COLOR, by which rich takes a pipe for a terminal, and run commands in a pseudo-terminal.
    """
    is_terminal = console.is_terminal and not console.is_dumb_terminal and console.file.isatty()
    return is_terminal and "JPY_PARENT_PID" not in os.environ


def _duration(seconds: float) -> str:
    minutes, rest = divmod(max(int(seconds), 0), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def similarity_table(
    similarity: Mapping[str, Mapping[str, Mapping[str, float]]], split_names: Mapping[str, str] = SPLIT_NAMES
) -> Table:
    """Similarity of expert and learner for each controller: means of the measures, with a section for each split."""
    title = "similarity (not optimised by any trainer); 0 is identical"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("learner moved by", no_wrap=True)
    for header in SIMILARITY_HEADERS.values():
        table.add_column(header, justify="right", no_wrap=True)
    splits = next(iter(next(iter(similarity.values())).values()))
    for split in splits:
        if len(splits) > 1:
            table.add_row(f"[italic]{split_names.get(split, split)}[/italic]")
        for name, measures in similarity.items():
            cells = (_similarity_cell(key, measures[key][split]) for key in SIMILARITY_HEADERS)
            table.add_row(SIMILARITY_NAMES.get(name, name.replace("_", " ")), *cells)
        table.add_section()
    return table


def _similarity_cell(key: str, value: float) -> str:
    if math.isnan(value):  # of an arm without a hand
        return "-"
    return f"{value:.1f} deg" if key.endswith("_deg") else f"{value:.3f}"


def report_table(report: Mapping[str, Any], trainer: Trainer) -> Table:
    """The metrics of a report by split, in the trainer's columns."""
    table = Table(title=f"{report['env']}  {report['trainer']}  seed {report['seed']}", title_justify="left")
    table.add_column("", no_wrap=True)  # rather the worst demonstrations, which are the widest cells of the others
    for header in trainer.columns:
        table.add_column(header, justify="right")
    for row in trainer.rows(dict(report)):
        table.add_row(*row)
    table.add_section()
    seconds = ", ".join(f"{name} {value:.0f}" for name, value in report["wall_time_s"].items())
    speed = f"{report['steps_per_second']:,.0f} /s" if report["steps_per_second"] else ""
    table.add_row(trainer.unit.replace("_", " "), f"{report[trainer.unit]:,}", speed)
    table.caption, table.caption_justify = f"seconds: {seconds}", "left"
    return table
