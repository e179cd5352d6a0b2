"""`python -m mimic.collect`: collects the runs in a folder in a table, a plot and a JSON file."""

import csv
import dataclasses
import io
import json
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mimic.base.config import check_writable
from mimic.base.files import write_atomically
from mimic.commands.collect.finished_runs import FinishedRun, LeftOut, QualityMetric, find_runs, quality_metric
from mimic.commands.collect.seed_groups import (
    CONFIDENCE,
    METHOD,
    Interval,
    SeedGroup,
    distinguishing_keys,
    drop_repeated,
    group_runs,
)
from mimic.commands.config import CollectConfig
from mimic.commands.printed import say
from mimic.evaluation.labels import SPLITS
from mimic.runs.files import REPORT

NAME = "collected"
SOME_LEFT_OUT = 1


def prepare_collection(config: CollectConfig) -> Callable[[], int]:
    """Reads the runs in a folder. The returned function writes the collection and returns 1 if runs were left out.

    Raises:
      ValueError: the folder does not exist or has no finished runs, the runs have several trainers, or `out` is a file.
    """
    if not config.folder:
        raise ValueError("expected a folder with runs in it, as in python -m mimic.collect runs")
    folder = Path(config.folder).expanduser()
    if not folder.is_dir():
        raise ValueError(f"{str(folder)!r}: there is no such folder; expected one with runs in it")
    out = Path(config.out).expanduser() if config.out else folder
    if out.exists() and not out.is_dir():
        raise ValueError(f"out: {str(out)!r} is a file; expected a folder")
    check_writable("out", out)
    finished, left_out = find_runs(folder)
    finished = [run for run in finished if config.only in ("", run.trainer)]
    if not finished:
        trainer = f" of trainer={config.only}" if config.only else ""
        reason = f"; {len(left_out)} without: {left_out[0].name}: {left_out[0].reason}" if left_out else ""
        raise ValueError(f"{str(folder)!r}: expected runs{trainer} with a {REPORT}, found none{reason}")
    trainers = sorted({run.trainer for run in finished})
    if len(trainers) > 1:
        raise ValueError(
            f"{str(folder)!r}: the runs are of {' and '.join(trainers)}, which have no metric in common; "
            f"choose with only={trainers[0]}"
        )
    finished, repeated = drop_repeated(finished)
    metric = quality_metric(trainers[0])
    assert metric is not None  # of a finished run
    return lambda: _collect(finished, [*left_out, *repeated], out, metric)


def _collect(finished: Sequence[FinishedRun], left_out: Sequence[LeftOut], out: Path, metric: QualityMetric) -> int:
    from mimic.commands.collect.plot import plot_collected  # imports matplotlib, which takes a second

    groups = group_runs(finished)
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / f"{NAME}.csv", _csv(groups))
    content = json.dumps(_summary(groups, left_out, metric), indent=2, default=str)
    write_atomically(out / f"{NAME}.json", content + "\n")
    plot_collected(groups, metric, out / f"{NAME}.png")
    console = Console()
    console.print(_table(groups, metric))
    versions = Counter(run.version for run in finished)
    if len(versions) > 1:
        counts = ", ".join(f"{version} ({count})" for version, count in sorted(versions.items()))
        print(f"note: the runs are of several versions of mimic: {counts}", file=sys.stderr)
    for run in left_out:
        print(f"left out: {run.name}: {run.reason}", file=sys.stderr)
    say(console, f"results: {out}/{NAME}.csv, .json, .png")
    return SOME_LEFT_OUT if left_out else 0


def _csv(groups: Sequence[SeedGroup]) -> str:
    """A table with one row per run: settings that differ between the groups, then the numbers of its report."""
    numbers = list(dict.fromkeys(key for group in groups for run in group.runs for key in run.numbers))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", *groups[0].settings, "seed", "mimic_version", *numbers])
    for group in groups:
        for run in group.runs:
            row = [run.numbers.get(key, "") for key in numbers]
            writer.writerow([run.name, *group.settings.values(), run.seed, run.version, *row])
    return text.getvalue()


def _summary(groups: Sequence[SeedGroup], left_out: Sequence[LeftOut], metric: QualityMetric) -> dict[str, Any]:
    return {
        "how": METHOD,
        "confidence": CONFIDENCE,
        "figure": metric.key,
        "groups": [
            {
                "label": group.label,
                "settings": group.settings,
                "seeds": [run.seed for run in group.runs],
                "runs": [run.name for run in group.runs],
                "numbers": {key: dataclasses.asdict(group.interval(key)) for key in _shared_numbers(group)},
            }
            for group in groups
        ],
        "left_out": [dataclasses.asdict(run) for run in left_out],
    }


def _shared_numbers(group: SeedGroup) -> list[str]:
    return [key for key in group.runs[0].numbers if all(key in run.numbers for run in group.runs)]


def _table(groups: Sequence[SeedGroup], metric: QualityMetric) -> Table:
    keys = distinguishing_keys(groups)
    table = Table(title=metric.label, title_justify="left")
    for key in keys:
        table.add_column(key, overflow="fold")
    for name in ("seeds", "training", "held out", metric.unit.replace("_", " ")):
        table.add_column(name, justify="right", no_wrap=True)
    for group in groups:
        table.add_row(
            *("-" if (value := group.settings[key]) is None else str(value) for key in keys),
            str(len(group.runs)),
            *(percent(group.interval(f"{metric.key}.{split}")) for split in SPLITS),
            f"{group.interval(metric.unit).mean:,.0f}",
        )
    table.caption = "mean ± half of its 95 % confidence interval (Student's t over seeds)"
    table.caption_justify = "left"
    return table


def percent(interval: Interval) -> str:
    """Mean and half of the confidence interval in percent; only the mean for a single number."""
    text = f"{100 * interval.mean:.2f}"
    return f"{text} %" if interval.high is None else f"{text} ± {100 * (interval.high - interval.mean):.2f} %"
