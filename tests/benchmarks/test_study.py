"""The study of dynamic imitation: what it asks for, how its runs are started, and what it makes of them."""

import csv
import json
import sys

import hydra
import pytest

from benchmarks import dynamic_imitation as study
from benchmarks import study_results
from benchmarks.processes import Task, run_tasks
from mimic import cli
from mimic.metric.config import MetricConfig

GROUPS = {case.group for case in study.cases(study.PRESETS["paper"])}


@pytest.fixture(scope="module")
def compose():
    cli._register_schemas()
    with hydra.initialize_config_module("mimic.conf", version_base="1.3"):
        yield hydra.compose


@pytest.mark.parametrize("name", study.PRESETS)
def test_every_run_and_evaluation_has_arguments_that_the_commands_take(name, compose, tmp_path):
    preset = study.PRESETS[name]
    chosen = study.cases(preset)
    unseen = {kind: tmp_path / f"{kind}.npz" for kind in ("pd", "reach")}
    trained = study.training_tasks(chosen, preset, tmp_path)
    evaluated = study.evaluation_tasks(chosen, tmp_path, unseen)
    assert len({task.folder for task in [*trained, *evaluated]}) == len(trained) + len(evaluated)
    for task in trained:
        if "seed=0" not in task.arguments or (name == "quick" and "locked" in task.folder.name):
            continue  # composing takes its time, and what differs is seen already
        assert compose("train", list(task.arguments)).env.physics == ("mjx" if "mjx" in task.folder.name else "fused")
    for task in evaluated:
        assert task.of in {run.folder for run in trained}
        compose("evaluate", [f"run={task.of}", f"out={task.folder}", *task.arguments])


def test_the_sweep_locks_every_joint_and_every_pair():
    names = {case.name for case in study.cases(study.PRESETS["paper"]) if case.group == "locked"}
    assert len(names) == 7 + 21 and {"locked-1", "locked-6-7"} <= names
    assert "locked" in GROUPS


def test_the_variants_change_the_metric_as_they_are_named(compose):
    cases = {case.name: case for case in study.cases(study.PRESETS["paper"]) if case.group == "variants"}
    reference = MetricConfig()
    for name, correspondence, links in (
        ("hard", "hard", "kept"),
        ("soft", "soft", "kept"),
        ("overlap", "overlap", "kept"),
        ("paper_metric", "overlap", "merged"),
        ("reference", reference.correspondence, reference.links),
    ):
        metric = compose("train", list(cases[f"variant-{name}"].arguments)).env.metric
        assert (metric.correspondence, metric.links, metric.xi) == (correspondence, links, reference.xi)


WRITE = "import pathlib, sys; p = pathlib.Path(sys.argv[1]); p.mkdir(); (p / 'report.json').write_text('{}')"


@pytest.fixture
def fake(monkeypatch):
    """Tasks that only write their report; one named "bad" fails."""
    started = []

    def command(task):
        started.append(task.folder.name)
        return [
            sys.executable,
            "-c",
            "raise SystemExit('no')" if "bad" in task.folder.name else WRITE,
            str(task.folder),
        ]

    monkeypatch.setattr(Task, "command", command)
    return started


def test_tasks_run_once_and_evaluations_after_their_runs(fake, tmp_path):
    run = Task(tmp_path / "run", ())
    tasks = [run, Task(tmp_path / "run--x", (), of=run.folder), Task(tmp_path / "other", ())]
    assert run_tasks(tasks, jobs=2, devices=0) == []
    assert all(task.done for task in tasks) and fake.index("run") < fake.index("run--x")
    fake.clear()
    assert run_tasks(tasks, jobs=2, devices=0) == [] and fake == []


def test_a_failed_run_is_named_with_its_evaluations_and_the_rest_goes_on(fake, tmp_path, capsys):
    bad = Task(tmp_path / "bad", ())
    tasks = [bad, Task(tmp_path / "bad--x", (), of=bad.folder), Task(tmp_path / "good", ())]
    failed = run_tasks(tasks, jobs=1, devices=0)
    assert [task.folder.name for task in failed] == ["bad", "bad--x"]
    assert tasks[2].done and "no" in capsys.readouterr().out


def test_an_interrupted_run_goes_on_and_a_broken_one_starts_anew(tmp_path):
    task = Task(tmp_path / "run", ("env=panda4dof",))
    task.folder.mkdir()
    assert f"run_dir={task.folder}" in task.command() and not task.folder.exists()
    (task.folder / "checkpoints" / "000000000100").mkdir(parents=True)
    assert task.command()[-1] == f"resume={task.folder}"


def test_results_are_grouped_by_case_and_seed(tmp_path):
    figures = {key: {"train": 0.5, "held_out": 0.6} for key in study_results._KEPT}
    for seed, gaps in ((1, (0.9, 0.2, 0.3)), (0, (0.8, 0.4))):
        folder = tmp_path / f"panda4dof-{seed}"
        folder.mkdir()
        (folder / "report.json").write_text(json.dumps({**figures, "env_steps": 10}))
        with (folder / "metrics.csv").open("w", newline="") as file:
            csv.writer(file).writerows([["quality/optimality_gap.train"], *([gap] for gap in gaps)])
    (tmp_path / "panda4dof-0--pd").mkdir()
    (tmp_path / "panda4dof-0--pd" / "report.json").write_text(json.dumps({**figures, "frequency_rad_s": 4.0}))
    results = study_results.collect(tmp_path)
    assert [entry["seed"] for entry in results["panda4dof"]] == [0, 1]
    assert (results["panda4dof"][1]["best_gap"], results["panda4dof"][1]["final_gap"]) == (0.2, 0.3)
    assert results["panda4dof--pd"][0]["frequency_rad_s"] == 4.0


def test_a_spread_is_the_standard_deviation_over_seeds():
    assert study_results.spread([0.01, 0.03]) == "2.00 ± 1.41 %"
    assert study_results.spread([0.01]) == "1.00 %"
