"""The report of a run: its content and its tables on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from mimic.evaluation.labels import SPLITS
from mimic.runs.provenance import hardware, versions
from mimic.runs.stopwatch import Stopwatch
from mimic.trainers.config import TrainConfig
from mimic.trainers.progress import report_table, similarity_table
from mimic.trainers.trainer import Trainer


def show_report(console: Console, report: Mapping[str, Any], trainer: Trainer) -> None:
    """Prints the tables of a report."""
    console.print(report_table(report, trainer))
    if "similarity" in report:
        console.print(similarity_table(report["similarity"], dict(zip(SPLITS, trainer.columns, strict=True))))


def make_report(
    config: TrainConfig, trainer: Trainer, metrics: Mapping[str, Any], stopwatch: Stopwatch, steps: int, trained: int
) -> dict[str, Any]:
    """Content of report.json.

    Args:
      config: config of the run.
      trainer: trainer of the run.
      metrics: metrics of the evaluation.
      stopwatch: wall time of the process, by stage.
      steps: training steps of the evaluated parameters.
      trained: training steps of this process.
    """
    wall_time = stopwatch.report()
    return {
        "env": config.env.name,
        "trainer": config.trainer.name,
        "seed": config.seed,
        **metrics,
        "wall_time_s": wall_time,
        trainer.unit: steps,
        "steps_per_second": trained / wall_time["train"] if wall_time["train"] else 0.0,
        "hardware": hardware(),
        "versions": versions(),
    }
