"""Collecting runs: which belong together, their intervals, and what is left out and named."""

import csv
import json
import math

import pytest

from mimic.commands.collect import plot
from mimic.commands.collect.collect import prepare_collection
from mimic.commands.collect.seed_groups import mean_interval
from mimic.commands.config import CollectConfig
from mimic.runs.sweeps.sweeper import SWEEP
from mimic.trainers import run_config
from mimic.trainers.presets import PPO_PRESETS
from tests.helpers.run_directories import write_run

PLOT = plot.plot_collected


@pytest.fixture(autouse=True)
def quick(monkeypatch, schemas):
    """Without the plot, which takes half a second, and with the schemas of configs made once."""
    monkeypatch.setattr(plot, "plot_collected", lambda *_: None)
    monkeypatch.setattr(run_config, "schema", schemas)


def collect(folder, **more):
    return prepare_collection(CollectConfig(folder=str(folder), **more))()


def collected(folder):
    return json.loads((folder / "collected.json").read_text())


def test_one_run_has_no_interval():
    interval = mean_interval([0.5])
    assert (interval.mean, interval.low, interval.high) == (0.5, None, None)


@pytest.fixture
def six(tmp_path):
    """Two environments, three seeds."""
    gaps = {"planar4dof": (0.03, 0.05, 0.04), "panda3dof": (0.2, 0.1, 0.3)}
    for env, finals in gaps.items():
        for seed, final in enumerate(finals):
            write_run(tmp_path / "sweep" / f"{env}-{seed}", [0.9, 0.5, final], env, seed)
    return tmp_path / "sweep"


def test_runs_that_differ_in_seed_alone_are_one_group(six, capsys, monkeypatch):
    monkeypatch.setattr(plot, "plot_collected", PLOT)
    assert collect(six) == 0
    groups = {group["label"]: group for group in collected(six)["groups"]}
    assert {label: group["seeds"] for label, group in groups.items()} == {
        "planar4dof": [0, 1, 2],
        "panda3dof": [0, 1, 2],
    }
    gap = groups["planar4dof"]["numbers"]["optimality_gap.train"]
    assert gap["mean"] == pytest.approx(0.04) and gap["high"] == pytest.approx(0.04 + 4.302653 * 0.01 / math.sqrt(3))
    assert groups["panda3dof"]["numbers"]["optimality_gap.held_out"]["max"] == pytest.approx(0.6)
    shown = capsys.readouterr().out
    assert "4.00 ± 2.48 %" in shown and "env.name" in shown
    assert "env.action_scale" not in shown  # differs too, but follows from the name
    with (six / "collected.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["env.name"], row["seed"]) for row in rows] == [
        (env, str(seed)) for env in ("panda3dof", "planar4dof") for seed in range(3)
    ]
    assert float(rows[0]["optimality_gap.held_out"]) == pytest.approx(0.4)
    assert "env.action_scale" in rows[0] and "env.horizon" not in rows[0]
    assert (six / "collected.png").stat().st_size > 10_000


def test_evaluations_are_groups_of_their_own(tmp_path, capsys):
    for seed in (0, 1):
        write_run(tmp_path / f"run{seed}", [0.1], seed=seed)
        for name in ("policy", "pd"):
            report = write_run(tmp_path / f"{name}{seed}", [0.2], seed=seed) / "report.json"
            evaluated = {"trainer": "ppo" if name == "policy" else name, "evaluated": {"demonstrations": ""}}
            report.write_text(json.dumps({**json.loads(report.read_text()), **evaluated}))
    assert collect(tmp_path) == 0
    groups = {group["settings"]["controller"]: group for group in collected(tmp_path)["groups"]}
    assert {name: group["seeds"] for name, group in groups.items()} == {None: [0, 1], "policy": [0, 1], "pd": [0, 1]}
    assert groups["pd"]["numbers"]["optimality_gap.train"]["mean"] == pytest.approx(0.2)
    labels = {name: group["label"] for name, group in groups.items()}
    assert labels == {None: "planar4dof", "policy": "controller=policy", "pd": "controller=pd"}
    assert "None" not in capsys.readouterr().out


def test_settings_that_the_name_does_not_tell_are_columns(tmp_path, capsys):
    for rate in (0.001, 0.0003):
        for seed in (0, 1):
            write_run(tmp_path / f"{rate}-{seed}", [0.5, rate * 100], seed=seed, learning_rate=rate)
    assert collect(tmp_path, out=str(tmp_path / "deep" / "out")) == 0
    assert [group["settings"] for group in collected(tmp_path / "deep" / "out")["groups"]] == [
        {"trainer.learning_rate": 0.0003},
        {"trainer.learning_rate": 0.001},
    ]
    assert "env.name" not in capsys.readouterr().out
    assert not (tmp_path / "collected.csv").exists()


def test_what_is_left_out_is_named_and_the_rest_is_kept(six, capsys):
    write_run(six / "stopped", [0.9, 0.5], seed=3, report=False)
    write_run(six / "diverged", [0.9, None], seed=4)
    (write_run(six / "torn", [0.9], seed=5) / "report.json").write_text('{"seed": 5,')
    write_run(six / "of-old", [0.9], seed=6, version="0.0.1")
    (six / "of-old" / "config.yaml").write_text("trainer: {name: ppo, momentum: 0.9}\n")
    planned = [
        {"label": "seed=7", "run_dir": "rejected", "exit_code": 2, "reason": "no such arm"},
        {"label": "seed=8", "run_dir": "waiting"},
        {"label": "seed=0", "run_dir": "planar4dof-0", "exit_code": 0, "reason": ""},
    ]
    (six / SWEEP).write_text(json.dumps({"runs": planned}))
    assert collect(six) == 1
    named = capsys.readouterr().err.splitlines()
    assert named == [f"left out: {run['name']}: {run['reason']}" for run in collected(six)["left_out"]]
    reasons = {run["name"]: run["reason"] for run in collected(six)["left_out"]}
    planned_steps = f"at 2,000 of {PPO_PRESETS['cpu']['num_timesteps']:,} steps"
    assert f"{planned_steps}; continue with: python -m mimic.train resume=" in reasons["stopped"]
    expected = "diverged, or without a meaningful gap: report.json has no number optimality_gap.train"
    assert reasons["diverged"] == expected  # and not of another version
    assert "report.json cannot be read" in reasons["torn"]
    assert "of mimic 0.0.1, and this is" in reasons["of-old"] and "momentum" in reasons["of-old"]
    assert reasons["rejected"] == "seed=7: failed: no such arm" and reasons["waiting"] == "seed=8: not started"
    assert len(reasons) == 6
    assert [len(group["seeds"]) for group in collected(six)["groups"]] == [3, 3]


def test_a_repetition_is_no_further_sample(tmp_path, capsys):
    for name in ("a", "b"):
        run = write_run(tmp_path / name, [0.5, 0.1 if name == "a" else 0.2])
    assert run and collect(tmp_path) == 1
    assert "left out: a: b has the same settings and seed, and is newer" in capsys.readouterr().err
    assert collected(tmp_path)["groups"][0]["numbers"]["optimality_gap.train"]["n"] == 1


def test_runs_of_several_versions_are_said_to_be(tmp_path, capsys):
    for seed, version in enumerate(("0.1.0", "0.2.0")):
        write_run(tmp_path / version, [0.5], seed=seed, version=version)
    assert collect(tmp_path) == 0
    assert "several versions of mimic: 0.1.0 (1), 0.2.0 (1)" in capsys.readouterr().err


def test_pose_mappers_are_collected_by_their_quality(tmp_path, capsys):
    for seed in range(2):
        write_run(tmp_path / f"mapper-{seed}", [0.5, 0.01], seed=seed, trainer="pose_mapper")
    write_run(tmp_path / "policy", [0.5])
    assert collect(tmp_path, only="pose_mapper") == 0
    shown = capsys.readouterr().out
    assert "distance above the optimum" in shown and "1.00 ± 0.00 %" in shown and "training poses" in shown


def test_bad_input(rejected):
    assert "expected a folder with runs in it" in rejected("collect")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{}/missing"], "there is no such folder"),
        (["{}/file"], "there is no such folder"),
        (["{}/stopped"], "expected runs with a report.json, found none; 1 without: run: no report.json"),
        (["{}/both"], "the runs are of pose_mapper and ppo, which have no metric in common; choose with only="),
        (["{}/both", "out={}/file"], "is a file; expected a folder"),
        (["{}/both", "only=sac"], "only: expected one of ppo, pose_mapper, got 'sac'"),
    ],
)
def test_bad_folders(reason, tmp_path, arguments, message):
    (tmp_path / "file").touch()
    if arguments == ["{}/stopped"]:
        write_run(tmp_path / "stopped" / "run", [0.5], report=False)
    if "both" in arguments[0]:
        write_run(tmp_path / "both" / "policy", [0.5])
        write_run(tmp_path / "both" / "mapper", [0.5], trainer="pose_mapper")
    assert message in reason("collect", *(argument.format(tmp_path) for argument in arguments))
