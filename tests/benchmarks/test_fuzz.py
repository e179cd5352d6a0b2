"""A part of the fuzzed inputs, which `python -m benchmarks.fuzz` runs as a whole, and how they are counted."""

import multiprocessing
import os
from pathlib import Path

import pytest

from benchmarks import fuzzing
from benchmarks.fuzzing import ACCEPTED, Case, runner
from benchmarks.fuzzing.captures import CAPTURE_DAMAGES
from benchmarks.fuzzing.files import MODEL_DAMAGES, NPZ_DAMAGES
from benchmarks.fuzzing.runner import GOOD, REJECTED, run_cases, run_here, summary

COUNTS = {
    "npz": 6 * len(NPZ_DAMAGES),
    "models": 3 * len(MODEL_DAMAGES),
    "captures": 4 * len(CAPTURE_DAMAGES),
}  # each damage some times


@pytest.mark.slow_for("models", "npz")
@pytest.mark.parametrize("kind", COUNTS)
def test_fuzzed_inputs_are_accepted_or_rejected_in_one_line(kind):
    rows = run_here(kind, range(COUNTS[kind]))
    assert [row for row in rows if row["outcome"] not in GOOD] == []
    assert {row["outcome"] for row in rows} == set(GOOD)
    assert max(row["s"] for row in rows) < runner.TIME_LIMIT


def test_a_case_is_the_same_each_time(tmp_path):
    contents = []
    for folder in (tmp_path / "first", tmp_path / "second"):
        folder.mkdir()
        case = fuzzing.make_case("npz")(0)
        case.write(folder)
        contents.append((folder / "motions.npz").read_bytes())
    assert contents[0] == contents[1]


def _hang(_):
    while True:
        pass


def _crash(_):
    os._exit(3)


def _raise(_):
    raise KeyError("name")


def _two_lines(_):
    raise ValueError("one\ntwo")


def _one_line(_):
    raise ValueError("one")


def _large(_):
    assert bytearray(400 * 2**20)
    return ACCEPTED


READS = (_one_line, lambda _: ACCEPTED, _raise, _two_lines, _hang, _crash, _large, _one_line)
OUTCOMES = (REJECTED, ACCEPTED, runner.TRACEBACK, runner.TRACEBACK, runner.HANG, runner.CRASH, runner.MEMORY, REJECTED)


def harmful_case(number):
    return Case("test", lambda _: None, READS[number])


@pytest.mark.slow
def test_harm_is_counted_and_the_next_inputs_run(monkeypatch):
    monkeypatch.setitem(fuzzing.KINDS, "npz", ("tests.benchmarks.test_fuzz", "harmful_case"))
    monkeypatch.setattr(runner, "TIME_LIMIT", 5.0)
    resident, shared = map(int, Path("/proc/self/statm").read_text().split()[1:3])
    private = (resident - shared) * os.sysconf("SC_PAGE_SIZE")  # a forked process starts with as much
    monkeypatch.setattr(runner, "MEMORY_LIMIT", private + 200 * 2**20)
    fork = multiprocessing.get_context("fork")  # the processes know of what is replaced here
    monkeypatch.setattr(runner.multiprocessing, "get_context", lambda _: fork)
    rows = run_cases("npz", len(READS), 1)
    assert tuple(row["outcome"] for row in rows) == OUTCOMES
    counts = summary("npz", rows)
    assert counts["inputs"] == len(READS) and counts[runner.TRACEBACK] == 2 and counts[runner.HANG] == 1
    assert [row["number"] for row in counts["bad"]] == [2, 3, 4, 5, 6]
