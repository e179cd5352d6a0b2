"""What a person sees of a run: a progress bar while it trains, a table at its end."""

import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table


class TrainingProgress:
    """A bar with distance, optimality gap, steps/s and time left; without a terminal, a line for each evaluation."""

    def __init__(self, console: Console, total_steps: int, done_steps: int = 0):
        self._console = console
        self._started, self._done, self._total = time.perf_counter(), done_steps, total_steps
        self._bar = Progress(
            TextColumn("[bold]training"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("train", total=total_steps, completed=done_steps, status="compiling")

    def __enter__(self) -> "TrainingProgress":
        self._bar.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._bar.stop()

    def update(self, step: int, quality: Mapping[str, Any], steps_per_second: float | None) -> None:
        """Shows the state after an evaluation."""
        gap, distance = quality["optimality_gap"], quality["mean_distance"]["train"]
        status = f"distance {distance:.4f}  gap {gap['train']:.1%}, held out {gap['held_out']:.1%}"
        if steps_per_second:
            left = max(self._total - step, 0) / steps_per_second
            status += f"  {steps_per_second:,.0f} steps/s  {_duration(left)} left"
        self._bar.update(self._task, completed=min(step, self._total), status=status)
        if not self._console.is_terminal:
            self._console.print(f"step {step:>11,}  {status}", soft_wrap=True, highlight=False)


def _duration(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def report_table(report: Mapping[str, Any]) -> Table:
    """The figures of a report, training next to held-out demonstrations."""
    table = Table(title=f"{report['env']}  {report['trainer']}  seed {report['seed']}", title_justify="left")
    table.add_column("")
    table.add_column("training", justify="right")
    table.add_column("held out", justify="right")
    for label, key, form in (
        ("optimality gap (0 best, 1 holding still)", "optimality_gap", "{:.2%}"),
        ("mean distance", "mean_distance", "{:.4f}"),
        ("  lower bound of this arm", "lower_bound", "{:.4f}"),
        ("  holding the start pose", "hold_distance", "{:.4f}"),
    ):
        table.add_row(label, form.format(report[key]["train"]), form.format(report[key]["held_out"]))
    table.add_row("angle to the expert's links", f"{report['link_angle_error_deg']:.1f} deg", "")
    table.add_row("steps with a torque at its limit", f"{report['torque_saturation']:.1%}", "")
    table.add_section()
    seconds = ", ".join(f"{name} {value:.1f}" for name, value in report["wall_time_s"].items())
    table.add_row("environment steps", f"{report['env_steps']:,}", f"{report['steps_per_second']:,.0f} /s")
    table.caption, table.caption_justify = f"seconds: {seconds}", "left"
    return table
