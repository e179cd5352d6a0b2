"""Groups of runs that differ in nothing but seed, and the confidence intervals of their means."""

import dataclasses
import json
import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.special

from mimic.sweeps.finished_runs import FinishedRun, LeftOut

CONFIDENCE = 0.95
HOW = (
    "mean over the seeds; low and high are mean -+ t s / sqrt(n), the interval of the mean with 95 % confidence: s is "
    "the sample standard deviation (by n - 1), t the 0.975 quantile of Student's t with n - 1 degrees of freedom; one "
    "seed has no interval"
)


@dataclasses.dataclass(frozen=True)
class Interval:
    """Mean of numbers, and the interval that their true mean lies in; low and high are None for a single number."""

    mean: float
    low: float | None
    high: float | None
    min: float
    max: float
    n: int


def mean_interval(values: Sequence[float]) -> Interval:
    """Mean with its confidence interval by Student's t, which takes the numbers for independent and normal."""
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
      label: what tells it from the other groups.
      settings: the keys that differ between groups, with its values.
      runs: by seed.
    """

    label: str
    settings: dict[str, Any]
    runs: list[FinishedRun]

    def interval(self, key: str) -> Interval:
        """Of a number of the reports."""
        return mean_interval([run.numbers[key] for run in self.runs])


def drop_repeated(runs: Sequence[FinishedRun]) -> tuple[list[FinishedRun], list[LeftOut]]:
    """Of runs with the same settings and seed the last alone: a repetition is no further sample."""
    newest: dict[tuple[str, int], FinishedRun] = {}
    repeated = []
    for run in sorted(runs, key=lambda run: run.finished):
        key = (_fingerprint(run), run.seed)
        if key in newest:
            repeated.append(LeftOut(newest[key].name, f"{run.name} has the same settings and seed, and is newer"))
        newest[key] = run
    kept = set(map(id, newest.values()))
    return [run for run in runs if id(run) in kept], repeated


def group_runs(runs: Sequence[FinishedRun]) -> list[SeedGroup]:
    """The groups, in the order of their first runs."""
    by_settings: dict[str, list[FinishedRun]] = defaultdict(list)
    for run in runs:
        by_settings[_fingerprint(run)].append(run)
    members = [sorted(group, key=lambda run: run.seed) for group in by_settings.values()]
    settings = [group[0].settings for group in members]
    keys = list(dict.fromkeys(key for one in settings for key in one))
    differing = [key for key in keys if len({_text(one.get(key)) for one in settings}) > 1]
    needed = _needed(differing, settings)
    return [
        SeedGroup(_label(group[0], needed), {key: group[0].settings.get(key) for key in differing}, group)
        for group in members
    ]


def telling_keys(groups: Sequence[SeedGroup]) -> list[str]:
    """Of the keys that differ, those that suffice to tell the groups apart: env.name says which joints are locked."""
    return _needed(list(groups[0].settings), [group.settings for group in groups])


def _needed(keys: Sequence[str], settings: Sequence[dict[str, Any]]) -> list[str]:
    """The names first, then what tells groups apart that are the same by all keys before it."""
    chosen: list[str] = []
    for key in sorted(keys, key=lambda key: not key.endswith(".name")):
        if _distinct(settings, [*chosen, key]) > _distinct(settings, chosen):
            chosen.append(key)
    return chosen


def _distinct(settings: Sequence[dict[str, Any]], keys: Sequence[str]) -> int:
    return len({tuple(_text(one.get(key)) for key in keys) for one in settings})


def _label(run: FinishedRun, keys: Sequence[str]) -> str:
    """The names by themselves, and other keys by their last part."""
    parts = [
        str(run.settings.get(key)) if key == "env.name" else f"{key.rpartition('.')[2]}={run.settings.get(key)}"
        for key in keys
    ]
    return " ".join(parts) or str(run.settings["env.name"])


def _fingerprint(run: FinishedRun) -> str:
    return _text(run.settings)


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True, default=str)
