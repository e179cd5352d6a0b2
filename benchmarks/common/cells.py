"""Cells of the pages' tables: the values of results files as text."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Results = Mapping[str, Any]
Cells = Sequence[str]

ENVIRONMENTS = {"panda7dof": "7 to 7", "panda4dof": "7 to 4", "panda3dof": "7 to 3"}
MEASURES = ("centre_line_distance", "tangent_angle_deg", "frechet_distance", "hand_position_error", "hand_angle_deg")
SIMILARITY_HEADER = ("centre line", "tangents", "Fréchet", "hand position", "hand direction")


def where(rows: Iterable[Results], **values: Any) -> list[Results]:
    """The rows with these values."""
    return [row for row in rows if all(row.get(key) == value for key, value in values.items())]


def one(rows: Iterable[Results], **values: Any) -> Results:
    """The only row with these values."""
    (row,) = where(rows, **values)
    return row


def span(values: Sequence[float], form: str = ".2f", factor: float = 100) -> str:
    """The minimum and the maximum as "a to b"; one number where both are written alike."""
    low, *_, high = (format(factor * value, form) for value in [min(values), *values, max(values)])
    return low if low == high else f"{low} to {high}"


def device(results: Results) -> str:
    """What a results file was measured on."""
    hardware = results["hardware"]
    return f"{hardware['cpu_cores']} cores" if hardware["backend"] == "cpu" else hardware["device"]


def percent(value: float, form: str = ".2f") -> str:
    """A fraction in percent."""
    return format(100 * value, form) + " %"


def large(value: float) -> str:
    """A rate with three digits and its power of a thousand: "3.2 M"."""
    for unit, name in ((1e9, " G"), (1e6, " M")):
        if value >= unit:
            return f"{value / unit:.3g}{name}"
    return f"{float(f'{value:.3g}'):,.0f}"


def split_pair(entry: Results, form: str = ".2f", factor: float = 100) -> str:
    """Training / held out."""
    return f"{factor * entry['train']:{form}} / {factor * entry['held_out']:{form}}"
