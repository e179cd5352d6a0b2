"""Bad input of commands: one line that names what is valid, exit code 2, nothing written."""

import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import mimic
from mimic import train
from mimic.__main__ import main
from mimic.commands import cli
from tests.helpers.repository import REPOSITORY


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["env=panda5dof"],
            "unknown env 'panda5dof'; valid are any_arm, bimanual, pair, panda3dof, panda4dof, panda7dof",
        ),
        (["trainer=sac"], "unknown trainer 'sac'; valid are "),
        (["env.world.payload=[0,1]"], "env.world.payload: expected with an inner loop, as in world=ideal"),
        (["env.arms.distinct=3"], "env.arms.distinct: expected with sampled arms, as in env=any_arm"),
        (["env.previw=1"], "unknown key 'env.previw'; valid are"),
        (["seed=one"], "could not be converted to Integer"),
        (["resume=missing"], "not a run directory"),
        (["+foo=1"], "foo"),
        (["env.learner.model=missing.xml"], "missing.xml"),
        (
            ["trainer=pose_mapper", "trainer.preset=huge"],
            "expected one of auto, paper, large, any_arm, any_arm_cpu, got 'huge'",
        ),
        (["trainer=pose_mapper", "trainer.num_envs=8"], "unknown key 'trainer.num_envs'; valid are name, preset"),
    ],
)
def test_bad_training_input(rejected, arguments, message):
    assert message in rejected("train", *arguments)


def test_bad_input_ends_the_process_with_one_line():
    result = subprocess.run(
        [sys.executable, "-m", "mimic.train", "env=panda5dof"], capture_output=True, text=True, timeout=60, check=False
    )
    assert result.returncode == 2 and result.stderr.count("\n") == 1 and "unknown env" in result.stderr


@pytest.mark.parametrize("command", ["train", "inspect"])
def test_the_version_is_that_of_mimic(command, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [f"mimic.{command}", "--version"])
    cli.run(lambda config: pytest.fail("the command ran"), command)
    assert capsys.readouterr().out == f"mimic {mimic.__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [([], "  train  "), (["--help"], "  train  "), (["--version"], f"mimic {mimic.__version__}\n")],
)
def test_the_overview_and_the_version(arguments, expected, capsys):
    assert main(arguments) == 0 and expected in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore:.*sys.modules:RuntimeWarning")  # runpy: the module is imported already
def test_the_console_script_runs_a_command(monkeypatch):
    """`mimic train KEY=VALUE` calls what `python -m mimic.train KEY=VALUE` calls, with the same arguments."""
    called = []
    monkeypatch.setattr(cli, "run", lambda *call: called.append((*call, list(sys.argv))))
    monkeypatch.setattr(sys, "argv", ["/bin/mimic", "train", "env=panda4dof", "seed=1"])
    assert main() == 0
    runpy.run_module("mimic.train", run_name="__main__")
    (prepare, name, argv), (_, same_name, _) = called
    assert (
        prepare is train.prepare and name == same_name == "train" and argv == ["mimic.train", "env=panda4dof", "seed=1"]
    )
    scripts = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {"mimic": f"{main.__module__}:{main.__name__}"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["trian"], "unknown command 'trian'; valid are collect, "),
        (["trian"], "; did you mean train?"),
        (["env=panda4dof"], "expected a command before 'env=panda4dof', as in mimic train env=panda4dof"),
    ],
)
def test_bad_commands(arguments, message, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("error: ") and error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["env=panda4dfo"], "panda4dof"),
        (["trainer=po"], "ppo"),
        (["env.previw=1"], "env.preview"),
        (["learning_rate=1"], "trainer.learning_rate"),
        (["env.limits=hardwere"], "hardware"),
    ],
)
def test_errors_suggest_the_closest_name(arguments, name, rejected):
    assert rejected("train", *arguments).endswith(f"; did you mean {name}?\n")


def test_nothing_is_suggested_where_nothing_is_close(rejected):
    assert "did you mean" not in rejected("train", "xyz=1")


def test_a_bad_arm_file(rejected, tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text("<mujoco><worldbody><body")
    assert "unclosed token" in rejected("train", "env=planar4dof", f"env.learner.model={path}")


def test_bad_run_directories(rejected, tmp_path):
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    (run_dir / "notes.txt").touch()
    assert "exists" in rejected("train", f"run_dir={run_dir}")


@pytest.mark.slow_for("None-not a run directory-train-resume")
@pytest.mark.parametrize(("command", "key"), [("train", "resume"), ("evaluate", "run"), ("render", "run")])
@pytest.mark.parametrize(
    ("config", "message"),
    [
        (None, "not a run directory"),
        ("trainer: {name: sac}\n", "expected one of"),
        ("trainer: {name: ppo, previw: 1}\n", "previw"),
        ("a: [\n", "cannot be read"),
    ],
)
def test_unreadable_run_directories(rejected, tmp_path, command, key, config, message):
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    if config is not None:
        (run_dir / "config.yaml").write_text(config)
    assert message in rejected(command, f"{key}={run_dir}")


@pytest.mark.parametrize("command", ["evaluate", "render"])
def test_run_directories_without_a_checkpoint(rejected, tmp_path, command):
    (tmp_path / "config.yaml").write_text("trainer: {name: ppo}\n")
    assert "no checkpoint" in rejected(command, f"run={tmp_path}")


def test_hydra_completes_keys_and_choices(monkeypatch, capsys):
    """What the completion of docs/install.md asks for."""
    monkeypatch.setenv("COMP_LINE", "mimic.train env=planar4")
    monkeypatch.setattr(sys, "argv", ["mimic.train", "-sc", "query=bash"])
    cli.run(train.prepare, "train")
    assert capsys.readouterr().out == "env=planar4dof\n"


def test_all_commands_are_listed():
    commands = {file.stem for file in (Path(mimic.__file__).parent / "conf").glob("*.yaml")}
    result = subprocess.run([sys.executable, "-m", "mimic"], capture_output=True, text=True, timeout=60, check=False)
    listed = [line.split(maxsplit=1) for line in result.stdout.splitlines()[2:]]
    names = {words[0] for words in listed if len(words) == 2 and words[0] != "mimic"}
    assert result.returncode == 0 and names == set(commands)


def test_help_names_the_environments():
    result = subprocess.run(
        [sys.executable, "-m", "mimic.train", "--help"], capture_output=True, text=True, timeout=60, check=False
    )
    assert result.returncode == 0 and "panda4dof" in result.stdout and "resume=DIR" in result.stdout
