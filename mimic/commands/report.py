"""The report of a run: what is in report.json, and what of it is shown."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from mimic.commands.progress import report_table, similarity_table
from mimic.runs.provenance import hardware, versions
from mimic.runs.stopwatch import Stopwatch
from mimic.trainers.config import TrainConfig
from mimic.trainers.trainer import Trainer


def show_report(console: Console, report: Mapping[str, Any], trainer: Trainer) -> None:
    """Prints a report as tables."""
    console.print(report_table(report, trainer))
    if "similarity" in report:
        console.print(similarity_table(report["similarity"]))


def make_report(
    config: TrainConfig, trainer: Trainer, figures: Mapping[str, Any], stopwatch: Stopwatch, steps: int, trained: int
) -> dict[str, Any]:
    """What report.json holds.

    Args:
      config: of the run.
      trainer: of the run.
      figures: of the evaluation.
      stopwatch: of the process.
      steps: that the evaluated parameters were trained for.
      trained: steps that this process trained.
    """
    wall_time = stopwatch.report()
    return {
        "env": config.env.name,
        "trainer": config.trainer.name,
        "seed": config.seed,
        **figures,
        "wall_time_s": wall_time,
        trainer.unit: steps,
        "steps_per_second": trained / wall_time["train"] if wall_time["train"] else 0.0,
        "hardware": hardware(),
        "versions": versions(),
    }
