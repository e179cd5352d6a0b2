"""The study asks for what the commands take."""

from pathlib import Path

import hydra
import pytest

from benchmarks import study
from mimic.commands import cli


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
        one_kind = case.group in ("simulations", "paper_setting")
        assert config.env.demonstrations.kind == ("pid" if one_kind else "mixed")
    evaluated = study.evaluations(cases, tmp_path)
    assert len(evaluated) == (22 if preset == "paper" else 18)
    kinds = {out.parent.name.partition("--")[2]: out for out in evaluated}
    for out in evaluated if preset == "paper" else kinds.values():
        config = compose("evaluate", evaluated[out][3:])
        run = Path(config.run)
        assert (config.out, run.parent.name) == (str(out), out.parent.name.partition("--")[0])
        assert any(case.name == run.parent.name and int(run.name) < case.seeds for case in cases)


def test_a_group_is_measured_once_all_of_its_runs_are_there(tmp_path):
    chosen = [case for case in study.cases("quick") if case.group == "unknown"]
    out = tmp_path / "study_cpu.json"
    assert study.measurements(chosen, tmp_path, out, 1) == {}
    for case in chosen:
        (tmp_path / case.name / "0").mkdir(parents=True)
        (tmp_path / case.name / "0" / "report.json").touch()
    ((results, command),) = study.measurements(chosen, tmp_path, out, 1).items()
    assert results == tmp_path / "unknown_cpu.json" and command[1:3] == ["-m", "benchmarks.unknown"]
    assert command[-2:] == [str(tmp_path / case.name / "0") for case in chosen]
    results.touch()
    assert study.measurements(chosen, tmp_path, out, 1) == {}


def test_no_real_arm_is_trained_on_where_it_is_unseen(compose):
    named = {
        case.name: compose("train", case.arguments).env for case in study.cases("paper") if case.group == "unseen_arms"
    }
    assert len(named) == 2 * len(study.STUDY["real"]) == 16
    for name in study.STUDY["real"]:
        arms, alone = named[f"{name}-unseen"].arms, named[f"{name}-alone"]
        assert arms.evaluated == [name] and {*arms.models, name} == set(study.STUDY["real"]) and name not in arms.models
        assert (alone.learner.model, alone.metric, alone.action_scale) == (
            *(name, named[f"{name}-unseen"].metric, named[f"{name}-unseen"].action_scale),
        )
