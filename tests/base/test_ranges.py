"""Ranges of the numbers in configs: every number has one, and its error names key, range and value."""

import dataclasses
import math
import typing
from typing import Any

import jax
import numpy as np
import pytest

from mimic.base.ranges import Range, all_ranges, check_ranges, number, ranges
from mimic.commands import config as commands
from mimic.trainers.config import PoseMapperConfig, PPOConfig, TrainConfig

CONFIGS = (
    TrainConfig,
    PPOConfig,
    PoseMapperConfig,
    *(value for name, value in vars(commands).items() if name.endswith("Config") and dataclasses.is_dataclass(value)),
)


@dataclasses.dataclass(frozen=True)
class Base:
    count: int = number(2, at_least=1, at_most=10_000)
    rate: float | None = number(None, above=0.0, at_most=1.0)
    widths: list[int] = number(list, at_least=1, at_most=9, entries=(0, 2))
    sharpness: float = number(-1.0, at_least=-1e6, below=0.0)

    def __post_init__(self) -> None:
        check_ranges(self, "base.")


@dataclasses.dataclass(frozen=True)
class Redeclared(Base):
    count: int = 3


def numbers_of(config_class, prefix=""):
    """Dotted keys of all fields that are numbers or lists of numbers."""
    types = typing.get_type_hints(config_class)
    for field in dataclasses.fields(config_class):
        kind = types[field.name]
        if dataclasses.is_dataclass(kind):
            yield from numbers_of(kind, f"{prefix}{field.name}.")
        elif {int, float} & {kind, *typing.get_args(kind)} or {list[int], list[float]} & {kind, *typing.get_args(kind)}:
            yield f"{prefix}{field.name}"


@pytest.mark.parametrize("config_class", CONFIGS, ids=lambda config_class: config_class.__name__)
def test_every_number_of_every_config_has_a_finite_range(config_class):
    declared = dict(all_ranges(config_class))
    assert set(numbers_of(config_class)) <= set(declared)
    assert all(math.isfinite(limits.minimum) and math.isfinite(limits.maximum) for limits in declared.values())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"count": 0}, "base.count: expected a whole number from 1 to 10,000, got 0"),
        ({"count": 10_001}, "base.count: expected a whole number from 1 to 10,000, got 10001"),
        ({"count": True}, "base.count: expected a whole number from 1 to 10,000, got True"),
        ({"count": "many"}, "base.count: expected a whole number from 1 to 10,000, got many"),
        ({"count": 10**400}, r"got 1000\d*... \(401 characters\)"),
        ({"rate": 0.0}, "base.rate: expected a number above 0 and at most 1, got 0.0"),
        ({"rate": math.nan}, "base.rate: expected a number above 0 and at most 1, got nan"),
        ({"rate": np.float32(np.inf)}, "base.rate: expected a number above 0 and at most 1, got inf"),
        ({"rate": [0.5]}, r"base.rate: expected a number above 0 and at most 1, got \[0.5\]"),
        ({"widths": [1, 10]}, r"base.widths: expected 0 to 2 whole numbers, each from 1 to 9, got \[1, 10\]"),
        ({"widths": [1, 1, 1]}, r"base.widths: expected 0 to 2 whole numbers, each from 1 to 9, got \[1, 1, 1\]"),
        ({"widths": [[1]]}, r"base.widths: .* got \[\[1\]\]"),
        ({"widths": "11"}, "base.widths: .* got 11"),
        ({"sharpness": 0.0}, r"base.sharpness: expected a number of at least -1e\+06 and below 0, got 0.0"),
    ],
)
def test_numbers_out_of_range_are_rejected(settings, message):
    with pytest.raises(ValueError, match=message):
        Redeclared(**settings)


def test_numbers_in_range_are_accepted():
    count: Any = np.int32(10_000)
    config = Base(count=count, rate=1.0, widths=[1, 9], sharpness=-1e6)
    assert config.count == 10_000 and Base().rate is None and ranges(Redeclared)["count"] == Range(1, 10_000)


def test_values_that_a_trace_does_not_know_are_accepted():
    jax.eval_shape(lambda rate: Base(rate=rate).rate, 0.5)
