"""The first inputs of `benchmarks.fuzz`: command lines and run directories."""

import os
from typing import Any

import pytest

from benchmarks.fuzzing import Case
from benchmarks.fuzzing.configs import command_line_case
from benchmarks.fuzzing.runner import GOOD, run_case, run_here
from benchmarks.fuzzing.runs import run_case as run_directory_case

COMMAND_LINES = 45
RUNS = 300  # of which every sixth and fifth is a checkpoint


@pytest.mark.slow_for("command_lines")
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", ["command_lines", pytest.param("runs", marks=pytest.mark.slow)])
def test_odd_inputs_end_in_one_line(kind):
    numbers = range(COMMAND_LINES) if kind == "command_lines" else [n for n in range(RUNS) if n % 6 < 4]
    bad = [row for row in run_here(kind, numbers) if row["outcome"] not in GOOD]
    assert not bad


def test_cases_are_the_same_in_each_process():
    def arguments() -> list[Any]:
        readers: list[Any] = [command_line_case(n).read for n in range(20)]
        return [reader.keywords for reader in readers]

    assert arguments() == arguments()
    assert len({run_directory_case(n).name for n in range(200)}) > 20


def test_a_revealed_variable_counts_as_harm(tmp_path):
    """The readers can fail: an error that shows the variable, and one that is no single line."""
    from benchmarks.fuzzing import configs

    def read(folder):
        return configs._read(folder, command="train", arguments=["seed=${oc.env:SECRET_TOKEN}"])

    outcome, message = run_case(Case("reference", lambda folder: None, read), tmp_path)
    assert outcome in GOOD or configs.SECRET in message
    assert configs.SECRET_NAME not in os.environ
