"""`python -m benchmarks.compare`."""

import json

import pytest

from benchmarks.compare import Value, changed, main, read_values


def _results(**rows):
    return {"benchmark": "b", "hardware": {"cpu_cores": 2}, "commit": "a", "date": "2026", **rows}


def test_values_are_named_by_the_text_and_the_sizes_of_their_row():
    rows = [{"case": "fused", "arms": 64, "steps_per_s": 10.0, "median_ms": 2.0, "spread": 0.1, "compile_s": 3.0}]
    entries = read_values(_results(rows=rows, deep={"a": {"b": 1}}))
    assert entries == {
        "rows / fused / arms=64 / steps_per_s": Value(10.0, 1.0),
        "rows / fused / arms=64 / median_ms": Value(2.0, 0.2),
        "rows / fused / arms=64 / compile_s": Value(3.0, 0.0),
        "deep / a / b": Value(1.0, 0.0),
    }


def test_seeds_are_one_value_with_their_standard_deviation():
    rows = [{"case": "x", "seed": seed, "gap": gap} for seed, gap in enumerate((1.0, 2.0, 3.0))]
    assert read_values(_results(rows=rows)) == {"rows / x / gap": Value(2.0, 1.0)}


def test_one_process_is_not_a_process_for_each_device():
    rows = [{"devices": 2, "processes": processes, "rate": 1.0 * processes} for processes in (1, 2)]
    assert set(read_values(_results(rows=rows)).values()) == {Value(1.0, 0.0), Value(2.0, 0.0)}


@pytest.mark.parametrize(
    "before, after, is_changed",
    [
        (Value(1.0, 0.1), Value(1.19, 0.1), False),  # within both spreads
        (Value(1.0, 0.1), Value(1.21, 0.1), True),
        (Value(1.0, 0.0), Value(1.04, 0.0), False),  # less than the minimum
        (Value(1.0, 0.0), Value(0.94, 0.0), True),
    ],
)
def test_a_change_is_beyond_the_spread_and_the_minimum(before, after, is_changed):
    assert changed(before, after, 0.05) == is_changed


def test_the_command_shows_what_changed_and_rejects_other_files(tmp_path, monkeypatch, capsys):
    def compare(*paths):
        monkeypatch.setattr("sys.argv", ["compare", *map(str, paths)])
        main()

    old, new, other = (tmp_path / name for name in ("old.json", "new.json", "other.json"))
    old.write_text(json.dumps(_results(rows=[{"case": "x", "time": 1.0, "gone": 1.0}])))
    new.write_text(json.dumps(_results(rows=[{"case": "x", "time": 2.0}])))
    other.write_text(json.dumps({**_results(), "benchmark": "c"}))
    compare(old, new)
    shown = capsys.readouterr().out
    assert "+100.0%" in shown and "1 of 1 values changed" in shown and "1 values are not in the new file" in shown
    for wrong in (tmp_path / "none.json", other):
        with pytest.raises(SystemExit, match="^error: ") as error:
            compare(old, wrong)
        assert "\n" not in str(error.value)
