"""Bad input of commands: one line that names what is valid, exit code 2, nothing written."""

import runpy
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
        (["env.world.payload=[0,1]"], "env.world.payload: expected with an inner loop, as in world=ideal"),
        (["env.observation=[twist]"], "env.observation: expected a list where it is one, as in [VALUE], and else keys"),
        (["env.observation.terms=x"], "env.observation.terms: expected a list, as in env.observation.terms=[VALUE]\n"),
        (["env.observation.terms=[null]"], "env.observation.terms[0]: expected a text, got null\n"),
        (["env.reward.terms=3"], "expected names and values, as in env.reward.terms={NAME:VALUE}\n"),
        (["env.horizon=null"], "env.horizon: expected a value, got null\n"),
        (["seed=one"], "seed: expected a whole number, got 'one'\n"),
        (["trainer.num_timesteps=1e6"], "expected a whole number, got 1000000.0; write 1000000\n"),
        (["seed=1.5"], "seed: expected a whole number, got '1.5'\n"),
        (["env.horizon=true"], "env.horizon: expected a whole number, got 'True'\n"),
        (["env.control_dt=x"], "env.control_dt: expected a number, got 'x'\n"),
        (["env.metric.adaptive=maybe"], "env.metric.adaptive: expected true or false, got 'maybe'\n"),
        (["env.metric.adaptive=2.0"], "env.metric.adaptive: expected true or false, got '2.0'\n"),
        (["+foo=1"], "foo"),
        (["trainer=pose_mapper", "trainer.num_envs=8"], "unknown key 'trainer.num_envs'; valid are name, preset"),
        (["env=panda4dfo"], "; did you mean panda4dof?\n"),
        (["learning_rate=1"], "; did you mean trainer.learning_rate?\n"),
        (["env.learner.locked=[9]"], "error: env.learner.locked: unknown joint 9"),
        (["learner.locked=[9]"], "error: learner.locked: unknown joint 9"),
        (
            ["env=pair", "env.learner.model=panda", "expert=panda", "env.learner.tip=x"],
            "env.learner.tip: expected",
        ),
        (["world=ideal", "env.control_dt=0.0015"], "error: env.control_dt: expected a multiple of 0.001 s"),
        (
            ["env.demonstrations.path=a.npz", "env.demonstrations.kind=reach"],
            "env.demonstrations.kind: expected",
        ),
    ],
)
def test_bad_training_input(rejected, arguments, message):
    error = rejected("train", *arguments)
    has_close_name = any(word in message for word in ("num_envs", "did you mean"))
    assert message in error and ("did you mean" in error) == has_close_name


def test_the_version_is_that_of_mimic(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["mimic.inspect", "--version"])
    cli.run(lambda config: pytest.fail("the command ran"), "inspect")
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == 2 * f"mimic {mimic.__version__}\n"


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
        (["trian"], "; did you mean train?"),
        (["env=panda4dof"], "expected a command before 'env=panda4dof', as in mimic train env=panda4dof"),
    ],
)
def test_bad_commands(arguments, message, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("error: ") and error.count("\n") == 1


def test_choices_suggest_the_closest_name(reason):
    assert reason("train", "env=panda4dof", "env.limits=hardwere").endswith("; did you mean hardware?")


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (None, "run: expected a run directory"),
        ("trainer: {name: ppo, previw: 1}\n", "config.yaml' cannot be read: unknown key 'trainer.previw'"),
        ("trainer: {name: ppo}\n", "no checkpoint"),
    ],
)
def test_unreadable_run_directories(rejected, tmp_path, config, message):
    if config is not None:
        (tmp_path / "config.yaml").write_text(config)
    assert message in rejected("evaluate", f"run={tmp_path}")


def test_hydra_completes_keys_and_choices(monkeypatch, capsys):
    """What the completion of docs/install.md asks for."""
    monkeypatch.setenv("COMP_LINE", "mimic.train env=planar4")
    monkeypatch.setattr(sys, "argv", ["mimic.train", "-sc", "query=bash"])
    cli.run(train.prepare, "train")
    assert capsys.readouterr().out == "env=planar4dof\n"


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_all_commands_are_listed(arguments, capsys):
    commands = {file.stem for file in (Path(mimic.__file__).parent / "conf").glob("*.yaml")}
    assert main(arguments) == 0
    listed = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()[2:]]
    assert {words[0] for words in listed if len(words) == 2 and words[0] != "mimic"} == set(commands)
