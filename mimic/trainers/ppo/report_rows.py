"""The final table of a training by PPO, and its most important metrics as one line."""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from mimic.evaluation.labels import ALL_KINDS, SPLITS
from mimic.evaluation.rollout_metrics import MIN_SPAN
from mimic.trainers.trainer import Metrics, Row

_EARLY = 0.5  # fraction of the gap, below which that of the second half is shown: most is the way from the start pose
_DISTANCES = (
    ("mean distance", "mean_distance", "{:.4f}"),
    ("  kinematic bound (gap 0)", "lower_bound", "{:.4f}"),
    ("  holding start pose (1)", "hold_distance", "{:.4f}"),
)
_OF_ONE_ARM = (
    ("optimality gap", "optimality_gap", "{:.2%}"),
    *_DISTANCES,
    ("angle to expert links", "link_angle_error_deg", "{:.1f} deg"),
    ("angular velocity error", "angular_velocity_error", "{:.2f} rad/s"),
    ("torque / maximum, rms", "torque_rms", "{:.1%}"),
    ("  change in a step, rms", "torque_change", "{:.1%}"),
    ("  steps at the maximum", "torque_saturation", "{:.1%}"),
    ("steps out of range", "position_violations", "{:.0f}"),
    ("  above velocity limit", "speed_violations", "{:.0f}"),
    ("  above torque limit", "torque_violations", "{:.0f}"),
)
_OF_MANY_ARMS = (
    ("optimality gap, mean over arms", "optimality_gap", "{:.2%}"),
    ("  median arm", "median_gap", "{:.2%}"),
    ("  worst arm", "largest_gap", "{:.2%}"),
    ("  without learning", "controller_gap", "{:.2%}"),
    *_DISTANCES,
    ("steps above velocity limit", "speed_violations", "{:.2%}"),
)


def status(metrics: Metrics) -> str:
    """The gaps by split, with the distance of one arm, or the gaps without learning of many."""
    gaps = metrics["optimality_gap"]
    if "controller_gap" in metrics:
        (seen, unseen), own = _texts("{:.2%}", gaps), "/".join(_texts("{:.2%}", metrics["controller_gap"]))
        return f"gap {seen}, unseen arms {unseen}  without learning {own}"
    train, held_out = _texts("{:.1%}", gaps)
    return f"distance {metrics['mean_distance']['train']:.4f}  gap {train}, held out {held_out}"


def rows(metrics: Metrics) -> list[Row]:
    """Rows of the gap, the distances that define it, and the other metrics."""
    if "arms" in metrics:
        rows = [(label, *_texts(form, metrics[key])) for label, key, form in _OF_MANY_ARMS]
        return [*rows[:3], *_worst_arms(metrics["arms"]), *rows[3:], *_counts(metrics["arms"])]
    rows: list[Row] = [(label, *_texts(form, metrics[key])) for label, key, form in _OF_ONE_ARM]
    if metrics["energy_distance"]:
        rows.insert(4, ("energy distance", *_texts("{:.4f}", metrics["energy_distance"])))
    rows[1:1] = _rows_of_kinds(metrics["by_kind"])
    gap, late = metrics["optimality_gap"], metrics["late_gap"]
    if any(gap[split] > 0 and late[split] < _EARLY * gap[split] for split in SPLITS):
        rows.insert(1, ("  in the second half", *_texts("{:.2%}", late)))
    rows += [
        (f"reward term {key.removeprefix('reward.')}", *_texts("{:.4f}", value))
        for key, value in metrics.items()
        if key.startswith("reward.")
    ]
    if "mjx" in metrics:
        rows.insert(1, ("  evaluated on MJX", *_texts("{:.2%}", metrics["mjx"]["optimality_gap"])))
    if not all(math.isfinite(gap) for gap in metrics["optimality_gap"].values()):
        rows.insert(1, ("  none: the best motion saves less than", f"{MIN_SPAN:.0%} of holding", "the start pose"))
    train, held_out = (
        "  ".join(f"{i}: {gap:.0%}" for i, gap in metrics["worst_demonstrations"][split].items()) for split in SPLITS
    )
    return [*rows, ("worst (number: gap)", train, held_out)]


def _rows_of_kinds(by_kind: Mapping[str, Mapping[str, Mapping[str, float]]]) -> list[Row]:
    """Rows of the gap of each kind of demonstrations, and of the interval of all."""

    def cells(kind: str, text: Callable[[Mapping[str, float]], str]) -> Row:
        train, held_out = (text(of[split]) if split in (of := by_kind[kind]) else "" for split in SPLITS)
        return f"  {kind.replace('_', ' ')}", train, held_out

    def interval(numbers: Mapping[str, float]) -> str:
        return f"{100 * numbers['low']:.2f} to {100 * numbers['high']:.2f}%" if numbers["low"] == numbers["low"] else ""

    intervals = cells(ALL_KINDS, interval)[1:]
    if not any(intervals):
        return []  # there is no gap
    rows: list[Row] = [("  95 % interval", *intervals)]
    if len(kinds := [kind for kind in by_kind if kind != ALL_KINDS]) > 1:
        rows += [cells(kind, lambda numbers: _text("{:.2%}", numbers["optimality_gap"])) for kind in kinds]
    return rows


def _by_split(arms: Mapping[str, Mapping[str, Any]]) -> list[dict[str, float]]:
    """The gaps of the arms that training has seen, and those of the others."""
    return [{name: arm["gap"] for name, arm in arms.items() if arm["seen"] == seen} for seen in (True, False)]


def _worst_arms(arms: Mapping[str, Mapping[str, Any]]) -> Iterator[Row]:
    """The row of the arms with the largest gaps."""
    finite = [{name: gap for name, gap in gaps.items() if not math.isnan(gap)} for gaps in _by_split(arms)]
    seen, unseen = (max(gaps, key=lambda name, gaps=gaps: gaps[name]) if gaps else "none" for gaps in finite)
    yield "    which is", seen, unseen


def _counts(arms: Mapping[str, Mapping[str, Any]]) -> Iterator[Row]:
    """Rows of the number of arms, and of those whose gap has no meaning."""
    seen, unseen = _by_split(arms)
    yield "arms", str(len(seen)), str(len(unseen))
    without = [sum(map(math.isnan, gaps.values())) for gaps in (seen, unseen)]
    if any(without):
        yield f"  without gap (span below {MIN_SPAN:.0%})", str(without[0]), str(without[1])


def _texts(form: str, by_split: Mapping[str, float]) -> tuple[str, str]:
    """The values of both splits; "none" for one without arms or without a gap that means something."""
    train, held_out = (_text(form, by_split.get(split, math.nan)) for split in SPLITS)
    return train, held_out


def _text(form: str, value: float) -> str:
    return form.format(value) if math.isfinite(value) else "none"
