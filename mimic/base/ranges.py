"""Ranges of the numbers in configs: declared once, with the field, and checked before anything is computed.

A field is declared as `horizon: int = number(50, at_least=1, at_most=10_000)`, and the `__post_init__` of its dataclass
calls `check_ranges`. A subclass that declares the field again without a range keeps the range.
"""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

_RANGE = "range"  # key in the metadata of a field
_MAX_SHOWN = 80  # characters of a rejected value in an error message


@dataclasses.dataclass(frozen=True)
class Range:
    """The valid values of a number, or of each number in a list.

    Attributes:
      minimum, maximum: the limits.
      above, below: whether the minimum or the maximum itself is excluded.
      entries: minimum and maximum number of entries of a list. Default None: a single number.
      by_name: whether a mapping from names to such numbers is valid too.
    """

    minimum: float
    maximum: float
    above: bool = False
    below: bool = False
    entries: tuple[int, int] | None = None
    by_name: bool = False

    @property
    def whole(self) -> bool:
        """Whether only integers are valid: both limits are integers."""
        return isinstance(self.minimum, int) and isinstance(self.maximum, int)

    def check(self, key: str, value: Any) -> None:
        """Raises a ValueError with the key, the range and the value if the value is out of range.

        Each number of a NumPy array counts; arrays of JAX pass, which have no value while it traces a function.
        """
        if self.by_name and isinstance(value, Mapping):
            is_valid = all(map(self.contains, value.values()))
        elif self.entries is None and isinstance(value, np.ndarray):
            is_valid = all(map(self.contains, value.flat))
        elif self.entries is not None:
            fewest, most = self.entries
            is_valid = not isinstance(value, str) and fewest <= len(value) <= most and all(map(self.contains, value))
        else:
            is_valid = self.contains(value) or not isinstance(value, int | float | np.number | Sequence | Mapping)
        if not is_valid:
            raise ValueError(f"{key}: expected {self}, got {_shortened(value)}")

    def contains(self, value: Any) -> bool:
        """Whether a value is a number within the limits; nan is not."""
        valid_types = (int, np.integer) if self.whole else (int, float, np.integer, np.floating)
        if not isinstance(value, valid_types) or isinstance(value, bool):
            return False
        over = value > self.minimum if self.above else value >= self.minimum
        under = value < self.maximum if self.below else value <= self.maximum
        return bool(over and under)

    def __str__(self) -> str:
        limits = f"from {_text(self.minimum)} to {_text(self.maximum)}"
        if self.above or self.below:
            lower, upper = "above" if self.above else "of at least", "below" if self.below else "at most"
            limits = f"{lower} {_text(self.minimum)} and {upper} {_text(self.maximum)}"
        kind = "whole number" if self.whole else "number"
        if self.entries is not None:
            return f"{_count(self.entries)} {kind}s, each {limits}"
        return f"a {kind} {limits}" + (", or a mapping from names to such numbers" if self.by_name else "")


def number(
    default: Any,
    *,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
    entries: tuple[int, int] | None = None,
    by_name: bool = False,
) -> Any:
    """A dataclass field with a range; None is always valid.

    Args:
      default: value of the field; for a list, a function that returns it.
      at_least, above: the minimum, with or without itself.
      at_most, below: the maximum, with or without itself. Where both are integers, only integers are valid.
      entries: minimum and maximum number of entries, for a list.
      by_name: whether a mapping from names to numbers is valid too; the field's type is then Any.
    """
    minimum, maximum = (at_least if above is None else above), (at_most if below is None else below)
    assert minimum is not None and maximum is not None
    metadata = {_RANGE: Range(minimum, maximum, above is not None, below is not None, entries, by_name)}
    if callable(default):
        return dataclasses.field(default_factory=default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def seed_number() -> Any:
    """A dataclass field for a random seed, a 64-bit integer."""
    return number(0, at_least=-(2**63), at_most=2**63 - 1)


def weight_number(default: float) -> Any:
    """Field for a weight of the metric: the sum of weighted squares stays far from float32's maximum of 3e38."""
    return number(default, at_least=0.0, at_most=1e6)


def checkpoint_number() -> Any:
    """Field for the training steps of a checkpoint; None for the last one."""
    return number(None, at_least=0, at_most=10**15)


@functools.cache
def ranges(config_class: type) -> dict[str, Range]:
    """The ranges of a dataclass by field, including those that its bases declare."""
    return {
        field.name: field.metadata[_RANGE]
        for base in reversed(config_class.__mro__)
        for field in base.__dict__.get("__dataclass_fields__", {}).values()
        if _RANGE in field.metadata
    }


def check_ranges(config: Any, prefix: str = "") -> None:
    """Raises a ValueError for the first number of a dataclass that is out of range.

    Args:
      config: the dataclass.
      prefix: of the keys in error messages, as "trainer.".
    """
    for name, limits in ranges(type(config)).items():
        value = getattr(config, name)
        if value is not None:
            limits.check(f"{prefix}{name}", value)


def all_ranges(config_class: type, prefix: str = "") -> Iterator[tuple[str, Range]]:
    """Dotted key and range of each number of a dataclass and of the dataclasses in it."""
    for name, limits in ranges(config_class).items():
        yield f"{prefix}{name}", limits
    for field in dataclasses.fields(config_class):
        if isinstance(field.default_factory, type) and dataclasses.is_dataclass(field.default_factory):
            yield from all_ranges(field.default_factory, f"{prefix}{field.name}.")


def _text(limit: float) -> str:
    return f"{limit:,}" if isinstance(limit, int) else f"{limit:g}"


def _count(entries: tuple[int, int]) -> str:
    fewest, most = entries
    return str(fewest) if fewest == most else f"{fewest} to {most}"


def _shortened(value: Any) -> str:
    text = str(value)
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}... ({len(text)} characters)"
