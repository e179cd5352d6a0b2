"""The checker that `conftest` applies to every function of the core."""

from collections.abc import Callable
from typing import Any

import beartype

_CONFIG = beartype.BeartypeConf(is_pep484_tower=True)  # an int where a float is annotated, as type checkers read it


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Checks arguments and results, but not the fields of dataclasses.

    JAX puts anything into the fields of a pytree: batches, gradients, placeholders of its own.
    """
    return function if function.__name__ == "__init__" else beartype.beartype(conf=_CONFIG)(function)
