"""Runs in a folder: the results of finished runs, and the reason why other runs are left out."""

import csv
import dataclasses
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mimic.base import registry
from mimic.base.config import flatten, to_dict
from mimic.base.distribution import NAME, VERSION
from mimic.base.files import read_json, read_text
from mimic.evaluation.labels import SPLITS
from mimic.runs.files import CONFIG, METRICS, REPORT
from mimic.runs.sweeps.sweeper import LOGS, SWEEP
from mimic.trainers.config import TrainConfig
from mimic.trainers.run_config import how_to_continue, load_config

# Keys that no result depends on.
_PROCESS_KEYS = ("run_dir", "resume", "logger", "compilation_cache", "distributed")


@dataclasses.dataclass(frozen=True)
class QualityMetric:
    """The metric by which runs of a trainer are compared: a fraction, 0 is optimal.

    Attributes:
      key: key in the report.
      label: label in tables and plots.
      unit: key of the training steps in the report.
    """

    key: str
    label: str
    unit: str


QUALITY_METRICS = {
    "ppo": QualityMetric("optimality_gap", "optimality gap", "env_steps"),
    "pose_mapper": QualityMetric("quality", "distance above the optimum", "training_poses"),
}


def quality_metric(trainer: str) -> QualityMetric | None:
    """The metric that runs of a trainer are compared by; a registered one has it in its attribute `quality_metric`."""
    if trainer in QUALITY_METRICS:
        return QUALITY_METRICS[trainer]
    own = getattr(registry.find("trainer", trainer, "trainer.name"), "quality_metric", None)
    return QualityMetric(*own) if own else None


@dataclasses.dataclass(frozen=True)
class FinishedRun:
    """A run with a report, or an evaluation of a run in a folder of its own.

    Attributes:
      name: its folder, below the one that is collected.
      trainer: its name.
      seed: of the run.
      settings: its config by dotted keys, without seed and what no result depends on; of an evaluation also controller,
        demonstrations and steps of the checkpoint.
      numbers: of its report by dotted keys, as optimality_gap.train.
      version: of mimic.
      curves: the quality metric over the steps, by split.
      finished: when its report was written [s since the epoch].
    """

    name: str
    trainer: str
    seed: int
    settings: dict[str, Any]
    numbers: dict[str, float]
    version: str
    curves: dict[str, dict[int, float]]
    finished: float


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """A run that is not collected, with the reason in one line."""

    name: str
    reason: str


def find_runs(folder: Path) -> tuple[list[FinishedRun], list[LeftOut]]:
    """Finds the runs in a folder, at any depth, sorted by name."""
    runs: dict[Path, FinishedRun | LeftOut] = {}
    planned: dict[Path, tuple[str, str]] = {}
    for path in _folders(folder):
        if (path / SWEEP).is_file():
            planned |= _planned(path)
        if (path / CONFIG).is_file():
            runs[path] = _read(path, _name(path, folder))
    for path, (label, reason) in planned.items():
        run = runs.get(path)
        if run is None:
            runs[path] = LeftOut(_name(path, folder), f"{label}: {reason or 'not started'}")
        elif isinstance(run, LeftOut) and reason:
            runs[path] = LeftOut(run.name, reason)
    ordered = [runs[path] for path in sorted(runs)]
    return [r for r in ordered if isinstance(r, FinishedRun)], [r for r in ordered if isinstance(r, LeftOut)]


def _folders(folder: Path) -> Iterator[Path]:
    """All folders except those in run directories, where loggers keep a config.yaml of their own."""
    for name, subfolders, files in os.walk(folder):
        subfolders[:] = [] if CONFIG in files else sorted(entry for entry in subfolders if not entry.startswith("."))
        yield Path(name)


def _name(path: Path, folder: Path) -> str:
    return os.path.relpath(path, folder) if path != folder else folder.resolve().name


def _planned(folder: Path) -> dict[Path, tuple[str, str]]:
    """Label of each run of a sweep by its folder, and the reason why it failed, if known."""
    try:
        entries = read_json(folder / SWEEP)["runs"]
        return {
            Path(os.path.normpath(folder / entry["run_dir"])): (entry["label"], _reason(folder, entry))
            for entry in entries
            if entry["run_dir"]
        }
    except (ValueError, LookupError, TypeError, OSError):
        return {}  # a sweep of another version; its run directories are read anyway


def _reason(folder: Path, entry: Mapping[str, Any]) -> str:
    if entry.get("exit_code"):
        return f"failed: {entry['reason']}"
    log = folder / LOGS / f"{Path(entry['run_dir']).name}.log"
    if "exit_code" in entry or not log.is_file():
        return ""
    last = [line.strip() for line in read_text(log, errors="replace").splitlines() if line.strip()][-1:]
    return f"not finished; its log ends with: {last[0]}" if last else ""


def _read(path: Path, name: str) -> FinishedRun | LeftOut:
    try:
        report = read_json(path / REPORT)
    except FileNotFoundError:
        report = None
    except (ValueError, OSError) as error:
        return LeftOut(name, f"{REPORT} cannot be read: {error}")
    version = _version(report or {})
    try:
        config = load_config(path, saved_models=False)  # runs of one arm are compared by its original path
    except ValueError as error:
        return LeftOut(name, f"{_other_version(version) if report else ''}{error}")
    try:
        history = _history(path / METRICS)
    except (ValueError, OSError, csv.Error) as error:
        return LeftOut(name, f"{METRICS} cannot be read: {error}")
    if report is None:
        return LeftOut(name, _progress(path, config, history))
    metric = quality_metric(config.trainer.name)
    if metric is None:
        return LeftOut(name, f"trainer {config.trainer.name} has no quality_metric")
    numbers = _numbers(report)
    missing = [key for split in SPLITS if (key := f"{metric.key}.{split}") not in numbers]
    if missing:
        reason = f"{_other_version(version)}diverged, or without a meaningful gap"
        return LeftOut(name, f"{reason}: {REPORT} has no number {missing[0]}")
    try:
        settings = flatten(to_dict(config)) | _evaluation_settings(report, config.trainer.name, metric, numbers)
    except (LookupError, TypeError) as error:
        return LeftOut(name, f"{REPORT} cannot be read: {error!r}")
    return FinishedRun(
        name=name,
        trainer=config.trainer.name,
        seed=config.seed,
        settings={key: x for key, x in settings.items() if key.split(".")[0] not in (*_PROCESS_KEYS, "seed")},
        numbers=numbers,
        version=version,
        curves={split: history.get(f"quality/{metric.key}.{split}", {}) for split in SPLITS},
        finished=(path / REPORT).stat().st_mtime,
    )


def _other_version(version: str) -> str:
    """The beginning of a reason, where the run is of another version of mimic than this one."""
    return f"of mimic {version}, and this is {VERSION}: " if version != VERSION else ""


def _evaluation_settings(
    report: Mapping[str, Any], trainer: str, metric: QualityMetric, numbers: Mapping[str, float]
) -> dict[str, Any]:
    """Controller, demonstrations and steps of an evaluation in a folder of its own; empty for a training."""
    if "evaluated" not in report:
        return {}
    return {
        "controller": "policy" if report.get("trainer") == trainer else str(report["trainer"]),
        "demonstrations": str(report["evaluated"]["demonstrations"]),
        metric.unit: numbers[metric.unit],
    }


def _progress(path: Path, config: TrainConfig, history: Mapping[str, Mapping[int, float]]) -> str:
    step = max((step for column in history.values() for step in column), default=0)
    progress = f"stopped or still running, at {step:,} of {config.trainer.total_steps:,} steps"
    return f"no {REPORT}: {progress}; {how_to_continue(path, config)}"


def _version(report: Mapping[str, Any]) -> str:
    versions = report.get("versions")
    return str(versions.get(NAME, "unknown")) if isinstance(versions, Mapping) else "unknown"


def _history(path: Path) -> dict[str, dict[int, float]]:
    """Columns of metrics.csv by step; for steps that a resumed run repeated, the last row.

    A last row without a line end is still being written, or was when the run was killed, and is left out.

    Raises:
      ValueError: a row that is damaged.
    """
    columns: dict[str, dict[int, float]] = {}
    if path.is_file():
        header, *rows = list(csv.reader(read_text(path).split("\n")[:-1])) or [[]]
        for number, row in enumerate(rows, start=2):
            if len(row) != len(header):
                raise ValueError(f"line {number} has {len(row)} cells, expected {len(header)}")
            values = dict(zip(header, row, strict=True))
            step = int(values.pop("step", ""))
            for key, value in values.items():
                if value:
                    columns.setdefault(key, {})[step] = float(value)
    return columns


def _numbers(report: Mapping[str, Any]) -> dict[str, float]:
    """The numbers of a report by dotted keys; null, which replaces values that are not finite, is left out."""
    flat = flatten({key: report[key] for key in report if key not in ("worst_demonstrations", "arms", "seed")})
    numbers = {key: x for key, x in flat.items() if isinstance(x, int | float) and abs(x) < math.inf}
    return {key: x for key, x in numbers.items() if not key.startswith("hardware")}
