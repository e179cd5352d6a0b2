"""Keys of arms mean the same in all commands, and a printed command has the config that it was printed for."""

import shlex
from pathlib import Path

import pytest
from rich.console import Console

import mimic
from mimic.commands.capture import training_env
from mimic.commands.collect.finished_runs import find_runs
from mimic.commands.printed import train_command
from mimic.envs.config import DemonstrationConfig, EnvConfig
from mimic.trainers.run_config import load_config
from mimic.trainers.run_training import _resumed_config, _stopped
from tests.helpers.commands import compose
from tests.helpers.run_directories import write_run

PREFIXES = {"train": "env.", "demonstrations": "env.", "retarget": "env.", "view": "env.", "inspect": ""}


def env_of(config):
    return getattr(config, "env", config)


@pytest.mark.parametrize("command", PREFIXES)
def test_arms_have_one_meaning_in_all_commands(command):
    config = env_of(compose(command, "learner=panda3dof", "expert=planar", "expert.link_lengths=[0.5,0.5]"))
    assert config.learner == mimic.env_config("panda3dof").learner
    assert config.expert == mimic.ArmConfig(model="planar", link_lengths=[0.5, 0.5])


@pytest.mark.parametrize("command", ["train", "inspect"])
def test_keys_of_arms_may_have_any_order(command):
    config = env_of(compose(command, "learner.tip=hand", "learner=panda", "learner.locked=[2]"))
    assert config.learner == mimic.ArmConfig(tip="hand", locked=[2])  # whatever arm the environment has, in any order
    prefix = PREFIXES[command]
    assert env_of(compose(command, f"{prefix}learner=panda", f"{prefix}learner.tip=hand")).learner.tip == "hand"


ENVIRONMENTS = {
    "preset": mimic.env_config("panda4dof"),
    "arms": EnvConfig(
        "pair",
        mimic.ArmConfig(locked={"joint2": 0.5}),
        mimic.ArmConfig(tip="it's", armature={"joint1": 0.2}, home=[0.1]),
    ),
    "tree": mimic.env_config("bimanual", expert={"model": "arms.xml", "tip": ["*"]}),
    "world": mimic.env_config("panda7dof", world="hardware", learner={"locked": [2, 5]}),
    "changed world": mimic.env_config("panda4dof", world={"payload": [0.0, 1.0]}, control="joint_position"),
    "metric": mimic.env_config("planar4dof", metric="paper", limits="hardware", limit_weight=2.0),
    "sampled arms": mimic.env_config("any_arm", arms={"most_locked": 3, "unseen": ["1+2"]}),
    "terms": mimic.env_config("panda4dof", reward={"terms": {"self_collision": 2.0}}),
}


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_printed_training_has_its_environment(name):
    python, module, command, *words = shlex.split(train_command(ENVIRONMENTS[name]))
    assert (python, module, command) == ("python", "-m", "mimic.train")
    assert compose("train", *words).env == ENVIRONMENTS[name]


@pytest.mark.parametrize("world", ["paper", "hardware"])
def test_a_training_on_a_clip_keeps_the_learner(world):
    env = mimic.env_config("panda7dof", world=world, learner={"locked": [7]})
    demonstrations = DemonstrationConfig("my clip.npz", count=8, held_out=2)
    trained = training_env(env, mimic.ArmConfig(model="clip.xml"), demonstrations)
    config = compose("train", *shlex.split(train_command(trained))[3:]).env
    assert config == trained and config.learner == env.learner and config.demonstrations == demonstrations
    assert config.world == env.world and bool(config.reward.terms) == (world == "hardware")


def test_a_printed_resume_continues_its_run(tmp_path, capsys):
    """That of a training that stops, and that of `collect` for a run without a report."""
    run_dir = write_run(tmp_path / "it's a run", [0.5], "panda3dof", report=False)
    _stopped(Console(), run_dir, load_config(run_dir), OSError("the disk is full"))
    _, (left_out,) = find_runs(tmp_path)
    for line in (capsys.readouterr().err, left_out.reason):
        python, module, command, *words = shlex.split(line.partition("continue with: ")[2])
        assert (python, module, command) == ("python", "-m", "mimic.train")
        requested, run = compose("train", *words), load_config(run_dir)
        resumed = _resumed_config(Path(requested.resume), requested, words)
        assert (resumed.env, resumed.trainer, resumed.seed) == (run.env, run.trainer, run.seed)
