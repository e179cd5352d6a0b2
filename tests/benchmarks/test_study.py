"""The study of dynamic imitation: what it asks for, how its runs are started, and what it makes of them."""

import csv
import json
import sys
from pathlib import Path

import hydra
import pytest

from benchmarks import dynamic_imitation as study
from benchmarks.common.processes import run_parallel
from mimic.commands import cli
from mimic.metric.config import MetricConfig
from tests.helpers.run_directories import write_run

UNSEEN = {f"{{{kind}}}": f"demonstrations={kind}.npz" for kind in ("computed_torque", "reach")}


@pytest.fixture(scope="module")
def compose():
    cli._register_schemas()
    with hydra.initialize_config_module("mimic.conf", version_base="1.3"):
        yield hydra.compose


@pytest.mark.slow_for("paper")
@pytest.mark.parametrize("preset", study.STUDY["presets"])
def test_every_run_and_evaluation_has_arguments_that_the_commands_take(preset, compose, tmp_path):
    cases = study.cases(preset)
    assert len({case.name for case in cases}) == len(cases)
    for case in cases if preset == "paper" else {case.group: case for case in cases}.values():
        command = case.command(tmp_path)
        assert command[1:4] == ["-m", "mimic.train", "-m"] and f"hydra.sweep.dir={tmp_path / case.name}" in command
        config = compose("train", case.arguments)
        assert config.env.physics == ("mjx" if case.group == "mjx" else "auto")
    evaluated = study.evaluations(cases, tmp_path, UNSEEN)
    assert len(evaluated) == (42 if preset == "paper" else 38)
    kinds = {out.parent.name.partition("--")[2]: out for out in evaluated}
    for out in evaluated if preset == "paper" else kinds.values():
        config = compose("evaluate", evaluated[out][3:])
        run = Path(config.run)
        assert (config.out, run.parent.name) == (str(out), out.parent.name.partition("--")[0])
        assert any(case.name == run.parent.name and int(run.name) < case.seeds for case in cases)


def test_the_sweep_locks_every_joint_and_every_pair():
    locked = {case.name: case.arguments for case in study.cases("paper") if case.group == "locked"}
    assert len(locked) == 7 + 21 and {"locked-1", "locked-6-7"} <= set(locked)
    assert "env.learner.locked=[6,7]" in locked["locked-6-7"]


def test_the_variants_change_the_metric_as_they_are_named(compose):
    cases = {case.name: case for case in study.cases("paper") if case.group == "variants"}
    reference = MetricConfig()
    for name, correspondence, links in (("hard", "hard", "kept"), ("paper_metric", "overlap", "merged")):
        metric = compose("train", cases[f"variant-{name}"].arguments).env.metric
        assert (metric.correspondence, metric.links) == (correspondence, links)
    assert f"env.metric.translation={4 * reference.translation:g}" in cases["variant-positions_x4"].arguments


def test_a_failed_command_is_named_and_the_rest_goes_on(tmp_path, capsys):
    commands = {
        tmp_path / "bad.log": [sys.executable, "-c", "raise SystemExit('no arm')"],
        tmp_path / "good.log": [sys.executable, "-c", "import os; print(os.environ['CUDA_VISIBLE_DEVICES'])"],
    }
    assert run_parallel(commands, jobs=1, devices=1) == [tmp_path / "bad.log"]
    assert "bad failed: no arm" in capsys.readouterr().out
    assert (tmp_path / "good.log").read_text() == "0\n"


def test_what_is_done_is_not_done_again(tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(study, "run_parallel", lambda commands, **_: started.append(list(commands)) or [])
    monkeypatch.setattr(study, "unseen_demonstrations", lambda _: UNSEEN)
    chosen = [case for case in study.cases("quick") if case.name in ("panda4dof", "panda3dof")]
    write_run(tmp_path / "panda4dof" / "0", [0.5])
    write_run(tmp_path / "panda4dof--pd" / "0", [0.5])
    study.run(chosen, tmp_path, jobs=1)
    (trained,), evaluated = started
    assert trained.stem == "panda3dof"
    names = {log.stem for log in evaluated}
    assert "panda4dof--hold-0" in names and "panda4dof--pd-0" not in names and "panda3dof--hold-0" not in names


def test_results_are_grouped_by_case_and_seed(tmp_path):
    entries = {key: {"train": 0.5, "held_out": 0.6} for key in study.STUDY["entries"]}

    def add(name, gaps, seed, **more):
        run = write_run(tmp_path / name / str(seed), gaps, seed=seed)
        report = json.loads((run / "report.json").read_text())
        (run / "report.json").write_text(json.dumps({**entries, **report, **more}))
        return run

    for seed, gaps in ((1, [0.9, 0.2, 0.3]), (0, [0.8, 0.4])):
        add("panda7dof", gaps, seed)
        with (tmp_path / "panda7dof" / str(seed) / "quality.csv").open("w", newline="") as file:
            csv.writer(file).writerows([["split", "time", "mean"], ["train", 0.1, 9], ["held_out", 0.1, 0.5]])
    pd = add("panda7dof--pd", [0.5], 0, trainer="pd", evaluated={"demonstrations": ""}, frequency_rad_s=4.0)
    (pd / "metrics.csv").unlink()
    results = study.collect(tmp_path)
    assert [entry["seed"] for entry in results["panda7dof"]] == [0, 1]
    assert (results["panda7dof"][1]["best_gap"], results["panda7dof"][1]["final_gap"]) == (0.2, 0.3)
    assert results["panda7dof"][0]["curves"] == {"time": [0.1], "mean": [0.5]}
    assert results["panda7dof--pd"][0]["frequency_rad_s"] == 4.0 and "best_gap" not in results["panda7dof--pd"][0]
