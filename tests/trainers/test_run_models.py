"""Model files in a run directory: the run goes on with its own arm, whatever happens to the original file."""

import dataclasses
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

import mimic
from mimic.arms.arm import build_arm
from mimic.commands.config import EvaluateConfig
from mimic.commands.evaluate import prepare_evaluation
from mimic.envs.family import arms_config, report_arms
from mimic.runs.files import CONFIG
from mimic.trainers.config import TrainConfig
from mimic.trainers.run_config import load_config, new_run_dir, save_config
from mimic.trainers.run_models import MODELS, RECORD, save_models, with_original_models
from tests.helpers import original_model
from tests.helpers.commands import command
from tests.helpers.run_directories import write_run
from tests.helpers.tiny import TINY
from tests.helpers.untrained_run import untrained_run

MESH = "".join(  # a tetrahedron
    ["v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\n", "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"]
)
LINK = '<asset><mesh file="l.obj"/></asset>'
PARTS = "<mujocoinclude><custom><numeric name='velocity_limit' data='1 2 3 4 5 6'/></custom></mujocoinclude>"
BODIES = "".join(
    f'<body pos="{x} 0 0"><joint name="joint{number}" axis="0 0 1" armature="0.02" damping="0.1"/>'
    '<geom type="capsule" size="0.02" fromto="0 0 0 0.5 0 0" mass="0.5"/>'
    for number, x in ((1, 0), (2, 0.5))
)
TWO_JOINTS = f'<mujoco model="two"><worldbody>{BODIES}</body></body></worldbody></mujoco>'


def write_arm(folder, kind):
    """An arm with a mesh in a folder of its own; the MJCF has an include too."""
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "l.obj").write_text(MESH)
    if kind == "urdf":
        (folder / "arm.urdf").write_text(original_model.urdf(mesh="package://arms/meshes/l.obj"))
        return folder / "arm.urdf"
    (folder / "limits.xml").write_text(PARTS)
    hand = '<body><geom type="mesh" mesh="l" mass="0.1"/></body>'
    text = original_model.ur_like(gripper=hand).replace("<worldbody>", f"{LINK}<worldbody>", 1)
    text = text.replace('autolimits="true"', 'autolimits="true" meshdir="meshes"')
    (folder / "arm.xml").write_text(text.replace("</mujoco>", '<include file="limits.xml"/></mujoco>'))
    return folder / "arm.xml"


@pytest.fixture
def run(tmp_path):
    """A run of an own arm, and the arm's file."""
    return start_run(tmp_path, "mjcf")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return start_run(tmp_path_factory.mktemp("finished"), "mjcf")[0]


def start_run(folder, kind):
    file = write_arm(folder / "arms" / "arm" if kind == "mjcf" else folder / "arms", kind)
    run_dir = write_run(folder / "run", [0.1])
    config = load_config(run_dir)
    env = mimic.env_config("pair", expert={"model": "planar", "link_lengths": [0.5, 0.5]}, learner=str(file))
    save_models(run_dir, env)
    save_config(run_dir, dataclasses.replace(config, env=env))
    return run_dir, file


def assert_same(arm, other):
    for field in dataclasses.fields(arm.embodiment):
        np.testing.assert_array_equal(getattr(arm.embodiment, field.name), getattr(other.embodiment, field.name))
    for name in ("body_mass", "body_inertia", "body_ipos", "body_pos", "dof_armature", "dof_damping"):
        np.testing.assert_array_equal(getattr(arm.model, name), getattr(other.model, name))


@pytest.mark.parametrize(("kind", "change"), [("mjcf", "changed"), ("mjcf", "deleted"), ("urdf", "moved")])
def test_a_run_keeps_its_arm(kind, change, tmp_path):
    run_dir, file = start_run(tmp_path, kind)
    original = load_config(run_dir, saved_models=False).env.learner
    assert original.model == str(file)
    arm = build_arm(original)
    if change == "moved":
        shutil.rmtree(file.parent)
        run_dir = run_dir.rename(tmp_path / "elsewhere")
    elif change == "changed":
        file.write_text(file.read_text().replace('"2"', '"7"').replace("8.4", "80"))
    else:
        file.unlink()
    assert_same(build_arm(load_config(run_dir).env.learner), arm)


def test_saving_the_config_again_keeps_original_path_and_models(run, tmp_path, monkeypatch):
    run_dir, file = run
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    run_dir = Path("..", run_dir.name)
    before = {path: path.read_bytes() for path in (run_dir / MODELS).rglob("*") if path.is_file()}
    file.unlink()
    config = load_config(run_dir)
    assert str(tmp_path / run_dir.name) in config.env.learner.model
    save_models(run_dir, config.env)
    save_config(run_dir, config)
    assert load_config(run_dir, saved_models=False).env.learner.model == str(file)
    assert f"/{MODELS}/" not in (run_dir / CONFIG).read_text()
    assert {path: path.read_bytes() for path in (run_dir / MODELS).rglob("*") if path.is_file()} == before


def test_a_run_that_starts_anew_replaces_the_models_of_one_without_config(run, tmp_path):
    run_dir, file = run
    (run_dir / CONFIG).rename(tmp_path / CONFIG)
    other = tmp_path / "other" / "two.xml"
    other.parent.mkdir()
    other.write_text(TWO_JOINTS)
    save_models(run_dir, mimic.env_config("pair", learner=str(other)))
    assert {path.name for path in (run_dir / MODELS / "learner").iterdir()} == {"two.xml"}
    unfinished = tmp_path / "unfinished"
    shutil.copytree(run_dir / MODELS, unfinished / MODELS)
    assert new_run_dir(TrainConfig(run_dir=str(unfinished))) == unfinished


def test_a_run_without_models_loads_as_before(run):
    run_dir, file = run
    shutil.rmtree(run_dir / MODELS)
    assert load_config(run_dir).env.learner.model == str(file)


def append(path):
    path.write_text(path.read_text() + " ")


def with_record(change):
    def apply(folder):
        record = json.loads((folder / RECORD).read_text())
        change(record)
        (folder / RECORD).write_text(json.dumps(record))

    return apply


CHANGES = {
    "a changed model": (lambda folder: append(next(folder.glob("learner/arm.*"))), "arm.* was changed since"),
    "a changed mesh": (lambda folder: append(next(folder.rglob("*.obj"))), "l.obj' was changed since"),
    "no mesh": (lambda folder: next(folder.rglob("*.obj")).unlink(), "l.obj' is missing since"),
    "another file": (lambda folder: (folder / "learner" / "a.xml").write_text(""), "a.xml' was added since"),
    "a pipe": (lambda folder: os.mkfifo(folder / "learner" / "a.xml"), "a.xml' was added since"),
    "no record": (lambda folder: (folder / RECORD).unlink(), "models.json' cannot be read: .*No such file"),
    "a broken record": (lambda folder: (folder / RECORD).write_text('{"arms'), "models.json' cannot be read: "),
    "a list": (lambda folder: (folder / RECORD).write_text("[]"), "models.json' cannot be read: "),
    "no checksums": (with_record(lambda record: record.pop("sha256")), "models.json' cannot be read: 'sha256'"),
    "no learner": (with_record(lambda record: record["arms"].clear()), "models.json' has no model of the learner"),
    "a file outside": (
        with_record(lambda record: record["arms"]["learner"].update(file="../config.yaml")),
        "models.json' has no model of the learner",
    ),
}


@pytest.mark.parametrize("case", CHANGES)
def test_changed_copies_are_rejected_in_one_line(finished, tmp_path, case):
    run_dir = shutil.copytree(finished, tmp_path / "run")
    change, message = CHANGES[case]
    change(run_dir / MODELS)
    with pytest.raises(ValueError, match=message) as error:
        load_config(run_dir)
    assert "\n" not in str(error.value)


def test_a_moved_run_is_evaluated_without_the_file_of_its_arm(tmp_path):
    file = tmp_path / "arm.xml"
    file.write_text(TWO_JOINTS)
    run_dir = untrained_run(tmp_path / "run", model=str(file))
    file.unlink()
    moved = run_dir.rename(tmp_path / "moved")
    prepare_evaluation(EvaluateConfig(str(moved), compilation_cache=""), 0.0)  # builds the arms and loads the policy


@pytest.mark.slow
def test_commands_use_the_arm_of_a_moved_run(tmp_path):
    """Training, evaluation and resuming, without the original file."""
    file = tmp_path / "arm.xml"
    file.write_text(TWO_JOINTS)
    arguments = [f"env.learner.model={file}", *TINY, f"run_dir={tmp_path / 'first'}", "compilation_cache="]
    assert not command("train", *arguments).returncode
    report = json.loads((tmp_path / "first" / "report.json").read_text())
    file.write_text(TWO_JOINTS.replace('mass="0.5"', 'mass="5"'))
    run_dir = (tmp_path / "first").rename(tmp_path / "run")
    assert not command("evaluate", f"run={run_dir}", f"out={tmp_path / 'out'}").returncode
    again = json.loads((tmp_path / "out" / "report.json").read_text())
    assert again["mean_distance"] == pytest.approx(report["mean_distance"], rel=1e-5)  # float32, in another process
    file.unlink()
    assert not command("train", f"resume={run_dir}", "trainer.num_timesteps=8000", "trainer.evaluations=1").returncode
    assert load_config(run_dir, saved_models=False).env.learner.model == str(file)


@pytest.fixture
def family_run(tmp_path):
    """A run of many arms, of which two are files and are named by their folder or file, and one has no file."""
    files = [write_arm(tmp_path / "arms" / "ur", "mjcf"), write_arm(tmp_path / "urdfs", "urdf")]
    files[0] = files[0].rename(files[0].with_name("robot.xml"))
    run_dir = write_run(tmp_path / "run", [0.1])
    arms = {"perturbed_fraction": 1.0, "models": ["panda", str(files[0])], "evaluated": [str(files[1])]}
    env = mimic.env_config("any_arm", arms=arms)
    save_models(run_dir, env)
    save_config(run_dir, dataclasses.replace(load_config(run_dir), env=env))
    return run_dir, files


@pytest.mark.slow
def test_a_run_keeps_all_of_many_arms(family_run, tmp_path):
    run_dir, files = family_run
    arms = report_arms(load_config(run_dir, saved_models=False).env)
    for file in files:
        shutil.rmtree(file.parent)
    run_dir = run_dir.rename(tmp_path / "elsewhere")
    env = load_config(run_dir).env
    assert arms_config(env).models[0] == "panda" and arms_config(env).models[1] == str(
        run_dir / MODELS / "ur" / "robot.xml"
    )
    kept = report_arms(env)
    assert {split: list(names) for split, names in kept.items()} == {
        split: list(names) for split, names in arms.items()
    }
    assert "ur" in kept["seen"] and "arm" in kept["unseen"]
    save_models(run_dir, env)
    assert arms_config(with_original_models(env)).models == ["panda", str(files[0])]
    append(run_dir / MODELS / "ur" / "robot.xml")
    with pytest.raises(ValueError, match="robot.xml' was changed since the training started"):
        load_config(run_dir)


def test_files_of_many_arms_have_different_names(tmp_path):
    files = [str(write_arm(tmp_path / name, "mjcf")) for name in ("a", "b")]
    env = mimic.env_config("any_arm", arms={"evaluated": files})
    with pytest.raises(
        ValueError, match="arms: expected files of different names, got '.*a/arm.xml' and '.*b/arm.xml'"
    ):
        save_models(tmp_path, env)
