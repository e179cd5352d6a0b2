"""Groups of runs that differ only in their seed, and the confidence intervals of their means."""

import dataclasses
import json
import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.special

from mimic.commands.collect.finished_runs import FinishedRun, LeftOut

CONFIDENCE = 0.95
METHOD = (
    "mean over the seeds; low and high are mean -+ t s / sqrt(n), the interval of the mean with 95 % confidence: s is "
    "the sample standard deviation (by n - 1), t the 0.975 quantile of Student's t with n - 1 degrees of freedom; one "
    "seed has no interval"
)


@dataclasses.dataclass(frozen=True)
class Interval:
    """Mean of numbers with its confidence interval; low and high are None for a single number."""

    mean: float
    low: float | None
    high: float | None
    min: float
    max: float
    n: int


def mean_interval(values: Sequence[float]) -> Interval:
    """Mean with its confidence interval by Student's t, which assumes independent normal samples."""
    mean, n = float(np.mean(values)), len(values)
    half = None
    if n > 1:
        quantile = float(scipy.special.stdtrit(n - 1, (1 + CONFIDENCE) / 2))
        half = quantile * float(np.std(values, ddof=1)) / math.sqrt(n)
    low, high = (None, None) if half is None else (mean - half, mean + half)
    return Interval(mean, low, high, float(min(values)), float(max(values)), n)


@dataclasses.dataclass(frozen=True)
class SeedGroup:
    """Runs with the same settings.

    Attributes:
      label: settings that distinguish the group from the others.
      settings: values of the keys that differ between groups.
      runs: runs of the group, sorted by seed.
    """

    label: str
    settings: dict[str, Any]
    runs: list[FinishedRun]

    def interval(self, key: str) -> Interval:
        """Mean and confidence interval of a number of the reports."""
        return mean_interval([run.numbers[key] for run in self.runs])


def drop_repeated(runs: Sequence[FinishedRun]) -> tuple[list[FinishedRun], list[LeftOut]]:
    """Keeps the newest of the runs with the same settings and seed: a repetition is not an independent sample."""
    newest: dict[tuple[str, int], FinishedRun] = {}
    repeated = []
    for run in sorted(runs, key=lambda run: run.finished):
        key = (_text(run.settings), run.seed)
        if key in newest:
            repeated.append(LeftOut(newest[key].name, f"{run.name} has the same settings and seed, and is newer"))
        newest[key] = run
    newest_ids = set(map(id, newest.values()))
    return [run for run in runs if id(run) in newest_ids], repeated


def group_runs(runs: Sequence[FinishedRun]) -> list[SeedGroup]:
    """Groups runs by their settings, in the order of the first run of each group."""
    by_settings: dict[str, list[FinishedRun]] = defaultdict(list)
    for run in runs:
        by_settings[_text(run.settings)].append(run)
    members = [sorted(group, key=lambda run: run.seed) for group in by_settings.values()]
    settings = [group[0].settings for group in members]
    keys = list(dict.fromkeys(key for group in settings for key in group))
    differing = [key for key in keys if len({_text(group.get(key)) for group in settings}) > 1]
    label_keys = _distinguishing(differing, settings)
    return [
        SeedGroup(_label(group[0], label_keys), {key: group[0].settings.get(key) for key in differing}, group)
        for group in members
    ]


def distinguishing_keys(groups: Sequence[SeedGroup]) -> list[str]:
    """The keys that suffice to distinguish the groups: env.name implies the locked joints, for example."""
    return _distinguishing(list(groups[0].settings), [group.settings for group in groups])


def _distinguishing(keys: Sequence[str], settings: Sequence[dict[str, Any]]) -> list[str]:
    """Adds keys, names first, as long as they distinguish groups that are equal in the keys before."""
    selected: list[str] = []
    for key in sorted(keys, key=lambda key: not key.endswith(".name")):
        if _count_distinct(settings, [*selected, key]) > _count_distinct(settings, selected):
            selected.append(key)
    return selected


def _count_distinct(settings: Sequence[dict[str, Any]], keys: Sequence[str]) -> int:
    return len({tuple(_text(group.get(key)) for key in keys) for group in settings})


def _label(run: FinishedRun, keys: Sequence[str]) -> str:
    """Text of these keys of a run, if it has them: env.name without its key, others with the last part of their key."""
    parts = [
        str(run.settings[key]) if key == "env.name" else f"{key.rpartition('.')[2]}={run.settings[key]}"
        for key in keys
        if key in run.settings
    ]
    return " ".join(parts) or str(run.settings["env.name"])


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True, default=str)
