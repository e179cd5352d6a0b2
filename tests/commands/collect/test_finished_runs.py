"""Runs with damaged files are left out with the reason in one line."""

import json

import pytest

from mimic.commands.collect.finished_runs import find_runs
from mimic.runs.files import METRICS, REPORT
from mimic.runs.sweeps.sweeper import SWEEP
from mimic.trainers import run_config
from tests.helpers.run_directories import write_run

HEADER = "step,quality/optimality_gap.train,quality/optimality_gap.held_out\n"


@pytest.fixture(autouse=True)
def quick(monkeypatch, schemas):
    """With the schemas of configs made once."""
    monkeypatch.setattr(run_config, "schema", schemas)


@pytest.mark.parametrize(
    ("file", "text", "reason"),
    [
        (REPORT, "[1]", r"report.json cannot be read: expected an object, got [1]"),
        (REPORT, "[" * 100_000, "report.json cannot be read: expected values that are not nested as deeply"),
        (REPORT, '{"optimality_gap": {"train": 1e400, "held_out": 1}}', "has no number optimality_gap.train"),
        (METRICS, f"{HEADER}1000,0.1,0.2,1000,0.1,0.2\n", "metrics.csv cannot be read: line 2 has 6 cells, expected 3"),
        (METRICS, f"{HEADER}1000,0.1,x\n", "metrics.csv cannot be read: could not convert string to float"),
        (METRICS, "quality\n0.1\n", "metrics.csv cannot be read: invalid literal for int"),
        (METRICS, f"{HEADER}1000,{'1' * 200_000},1\n", "metrics.csv cannot be read: field larger than field limit"),
        ("config.yaml", "trainer: {name: ppo, batch_size: 3}\n", "must be a multiple of num_envs"),
    ],
)
def test_damaged_runs_are_left_out(tmp_path, file, text, reason):
    run_dir = write_run(tmp_path / "run", [0.5, 0.2])
    (run_dir / file).write_text(text)
    finished, (left_out,) = find_runs(tmp_path)
    assert not finished and reason in left_out.reason and "\n" not in left_out.reason


def test_an_evaluation_without_its_conditions_is_left_out(tmp_path):
    run_dir = write_run(tmp_path / "run", [0.5, 0.2])
    report = json.loads((run_dir / REPORT).read_text())
    (run_dir / REPORT).write_text(json.dumps({**report, "evaluated": 3}))
    finished, (left_out,) = find_runs(tmp_path)
    assert not finished and "report.json cannot be read: " in left_out.reason


def test_half_a_last_row_is_ignored(tmp_path):
    run_dir = write_run(tmp_path / "run", [0.5, 0.2])
    with (run_dir / METRICS).open("a") as file:
        file.write("3000,0.0")
    (finished,), left_out = find_runs(tmp_path)
    assert finished.curves["train"] == {1000: 0.5, 2000: 0.2} and not left_out


@pytest.mark.parametrize("text", ["[", "{}", '{"runs": [3]}', '{"runs": {"a": 1}}'])
def test_a_damaged_plan_of_a_sweep_is_ignored(tmp_path, text):
    write_run(tmp_path / "run", [0.5, 0.2])
    (tmp_path / SWEEP).write_text(text)
    finished, left_out = find_runs(tmp_path)
    assert len(finished) == 1 and not left_out
