"""Damaged and hostile inputs, what mimic does with them, and how it is counted.

A kind of input is a module of this folder's `KINDS` with a function that makes case number `n` of a fixed seed. A case
writes its input into an empty folder and reads it there.
"""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

ACCEPTED, OTHER_NUMBERS = "accepted", "accepted_with_other_numbers"


class Case(NamedTuple):
    """One input.

    Attributes:
      name: what is wrong with it.
      write: writes the input into an empty folder.
      read: reads it there as a user's command does; returns `ACCEPTED` or `OTHER_NUMBERS`, or raises a ValueError.
    """

    name: str
    write: Callable[[Path], None]
    read: Callable[[Path], str]


MakeCase = Callable[[int], Case]  # case number n
KINDS = {  # module and function
    "npz": ("benchmarks.fuzzing.files", "npz_case"),
    "models": ("benchmarks.fuzzing.files", "model_case"),
    "command_lines": ("benchmarks.fuzzing.configs", "command_line_case"),
    "captures": ("benchmarks.fuzzing.captures", "capture_case"),
    "runs": ("benchmarks.fuzzing.runs", "run_case"),
}


def make_case(kind: str) -> MakeCase:
    """The function that makes the cases of a kind."""
    module, function = KINDS[kind]
    return getattr(importlib.import_module(module), function)
