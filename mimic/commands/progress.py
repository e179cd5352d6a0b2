"""Progress bars of a training and a search, and the tables of a report."""

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from mimic.evaluation.labels import SIMILARITY_HEADERS, SIMILARITY_NAMES, SPLIT_NAMES
from mimic.trainers.trainer import Trainer


class TrainingProgress:
    """A progress bar with metrics, steps/s and remaining time; without a terminal, one line for each evaluation."""

    def __init__(self, console: Console, total_steps: int, done_steps: int = 0):
        self._console = console
        self._total = total_steps
        self._bar = _progress_bar(console, "training")
        self._task = self._bar.add_task("train", total=total_steps, completed=done_steps, status="compiling")

    def __enter__(self) -> "TrainingProgress":
        self._bar.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._bar.stop()

    def update(self, step: int, status: str, steps_per_second: float | None) -> None:
        """Shows the state after an evaluation at a step."""
        if steps_per_second:
            left = max(self._total - step, 0) / steps_per_second
            status += f"  {steps_per_second:,.0f} steps/s  {_duration(left)} left"
        self._bar.update(self._task, completed=min(step, self._total), status=status)
        if not self._console.is_terminal:
            self._console.print(f"step {step:>11,}  {status}", soft_wrap=True, highlight=False)


class SearchProgress:
    """A progress bar over the updates of a search, shown from the first one on; without a terminal, ten lines."""

    def __init__(self, console: Console, total: int):
        self._console, self._total = console, total
        self._bar = _progress_bar(console, "searching")
        self._task = self._bar.add_task("search", total=total, status="compiling")

    def __enter__(self) -> "SearchProgress":
        return self

    def __exit__(self, *_: Any) -> None:
        if self._bar.live.is_started:
            self._bar.stop()

    def update(self, done: int, status: str) -> None:
        """Shows the state after `done` updates."""
        self._bar.start()
        self._bar.update(self._task, completed=done, status=status)
        if not self._console.is_terminal and (done % max(self._total // 10, 1) == 0 or done == self._total):
            self._console.print(f"searching {done:>4} of {self._total}  {status}", soft_wrap=True, highlight=False)


def _progress_bar(console: Console, label: str) -> Progress:
    """A bar with a status text, hidden without a terminal."""
    columns = BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[status]}"), TimeElapsedColumn()
    return Progress(TextColumn(f"[bold]{label}"), *columns, console=console, disable=not console.is_terminal)


def _duration(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def similarity_table(similarity: Mapping[str, Mapping[str, Mapping[str, float]]]) -> Table:
    """Similarity of expert and learner for each controller: means of the measures, with a section for each split."""
    title = "similarity (not optimised by any trainer); 0 is identical"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("learner moved by", no_wrap=True)
    for header in SIMILARITY_HEADERS.values():
        table.add_column(header, justify="right", no_wrap=True)
    splits = next(iter(next(iter(similarity.values())).values()))
    for split in splits:
        if len(splits) > 1:
            table.add_row(f"[italic]{SPLIT_NAMES.get(split, split)}[/italic]")
        for name, measures in similarity.items():
            cells = (_similarity_cell(key, measures[key][split]) for key in SIMILARITY_HEADERS)
            table.add_row(SIMILARITY_NAMES.get(name, name.replace("_", " ")), *cells)
        table.add_section()
    return table


def _similarity_cell(key: str, value: float) -> str:
    return f"{value:.1f} deg" if key.endswith("_deg") else f"{value:.3f}"


def report_table(report: Mapping[str, Any], trainer: Trainer) -> Table:
    """The metrics of a report, on training and held-out data."""
    table = Table(title=f"{report['env']}  {report['trainer']}  seed {report['seed']}", title_justify="left")
    table.add_column("")
    table.add_column("training", justify="right")
    table.add_column("held out", justify="right")
    for row in trainer.rows(dict(report)):
        table.add_row(*row)
    table.add_section()
    seconds = ", ".join(f"{name} {value:.1f}" for name, value in report["wall_time_s"].items())
    speed = f"{report['steps_per_second']:,.0f} /s" if report["steps_per_second"] else ""
    table.add_row(trainer.unit.replace("_", " "), f"{report[trainer.unit]:,}", speed)
    table.caption, table.caption_justify = f"seconds: {seconds}", "left"
    return table
