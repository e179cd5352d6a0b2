"""A part of the fuzzed inputs, which `python -m benchmarks.fuzz` runs as a whole, and how harm is counted."""

import os

import pytest

from benchmarks import fuzz

COUNTS = {"motions": 34, "models": 34, "captures": 34, "runs": 17, "command_lines": 17}  # each change once or twice


@pytest.fixture(autouse=True)
def secret(monkeypatch):
    monkeypatch.setenv(fuzz.SECRET_NAME, fuzz.SECRET)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", COUNTS)
def test_changed_files_are_accepted_or_rejected_in_one_line(kind):
    rows = [fuzz.run_case(kind, number) for number in range(COUNTS[kind])]
    assert [row for row in rows if row["outcome"] not in fuzz.GOOD] == []
    assert {row["outcome"] for row in rows} == set(fuzz.GOOD)


def test_a_case_is_the_same_each_time(tmp_path, monkeypatch):
    contents = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        _, changed = fuzz.write_case("captures", 3)
        contents.append(changed.read_bytes())
    assert contents[0] == contents[1] != fuzz.example("captures")[changed]


def _raise(message):
    raise ValueError(message)


READS = {
    fuzz.REJECTED: lambda *_: _raise("one line"),
    fuzz.ACCEPTED: lambda *_: 1,
    fuzz.TRACEBACK: lambda *_: _raise("two\nlines"),
    fuzz.REVEALED: lambda *_: _raise(fuzz.SECRET),
}


@pytest.mark.parametrize("outcome", READS)
def test_outcomes(monkeypatch, outcome):
    monkeypatch.setitem(fuzz.KINDS, "command_lines", (fuzz.KINDS["command_lines"][0], READS[outcome]))
    assert fuzz.run_case("command_lines", 0)["outcome"] == outcome


def test_other_numbers_of_a_file_with_checksums_are_harm(monkeypatch):
    monkeypatch.setattr(fuzz, "_value_of_example", lambda *_: b"")
    number = next(n for n in range(200) if _changed(n).endswith("recorded.npz"))
    monkeypatch.setitem(fuzz.KINDS, "motions", (fuzz.KINDS["motions"][0], lambda *_: 1))
    assert fuzz.run_case("motions", number)["outcome"] == fuzz.OTHER_NUMBERS


def _changed(number):
    import contextlib
    import tempfile

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        return str(fuzz.write_case("motions", number)[1])


def _crash(kind, number):
    os._exit(3)


@pytest.mark.slow
def test_a_process_that_crashes_is_counted_and_replaced(monkeypatch):
    monkeypatch.setattr(fuzz, "run_limited_case", _crash)
    assert [row["outcome"] for row in fuzz.run_cases("runs", range(2), 1)] == [fuzz.CRASH] * 2
