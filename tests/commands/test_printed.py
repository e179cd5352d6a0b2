"""Keys of arms mean the same in all commands, and a printed command has the config that it was printed for."""

import shlex

import hydra
import pytest

import mimic
from mimic.base.config import typed
from mimic.commands import cli
from mimic.commands.capture import training_env
from mimic.commands.printed import train_command
from mimic.envs.config import DemonstrationConfig, EnvConfig

PREFIXES = {"train": "env.", "demonstrations": "env.", "retarget": "env.", "view": "env.", "inspect": ""}


@pytest.fixture(scope="module")
def composed():
    """The typed config of a command's arguments."""
    cli.register()
    with hydra.initialize_config_module("mimic.conf", version_base="1.3"):
        yield lambda command, *arguments: typed(hydra.compose(command, cli.expand_arguments(list(arguments), command)))


def env_of(config):
    return getattr(config, "env", config)


@pytest.mark.parametrize("command", PREFIXES)
def test_arms_have_one_meaning_in_all_commands(command, composed):
    config = env_of(composed(command, "learner=panda3dof", "expert=planar", "expert.link_lengths=[0.5,0.5]"))
    assert config.learner == mimic.env_config("panda3dof").learner
    assert config.expert == mimic.ArmConfig(model="planar", link_lengths=[0.5, 0.5])
    config = env_of(composed(command, "learner.tip=hand", "learner=panda", "learner.locked=[2]"))
    assert config.learner == mimic.ArmConfig(tip="hand", locked=[2])  # whatever arm the environment has, in any order
    prefix = PREFIXES[command]
    assert env_of(composed(command, f"{prefix}learner=panda", f"{prefix}learner.tip=hand")).learner.tip == "hand"


@pytest.mark.parametrize("command", PREFIXES)
def test_an_environment_without_arms_of_its_own_is_none(command):
    with pytest.raises(
        ValueError, match="learner: expected an arm, or an environment with arms of its own, got 'pair'"
    ):
        cli.expand_arguments(["learner=pair"], command)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run=a", "expert=panda"], "expert, learner: expected neither with run= or mapper="),
        (["mapper=any_arm", "env.learner.tip=hand"], "mapper=any_arm takes learners="),
        (["source=clip.bvh", "expert=panda"], "expert: expected none with source=, whose person is the expert"),
    ],
)
def test_a_view_rejects_arms_without_effect(arguments, message):
    with pytest.raises(ValueError, match=message):
        cli.expand_arguments(arguments, "view")


def test_a_training_that_goes_on_with_an_arm_keeps_its_key():
    assert cli.expand_arguments(["init=runs/a", "learner=ur5e"], "train") == ["init=runs/a", "learner=ur5e"]


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
    "sampled arms": mimic.env_config("any_arm", arms={"distinct": 3, "unseen": ["1+2"]}),
    "terms": mimic.env_config("panda4dof", reward={"terms": {"self_collision": 2.0}}, start="nearest"),
}


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_printed_training_has_its_environment(name, composed):
    python, module, command, *words = shlex.split(train_command(ENVIRONMENTS[name]))
    assert (python, module, command) == ("python", "-m", "mimic.train")
    assert composed("train", *words).env == ENVIRONMENTS[name]


@pytest.mark.parametrize("world", ["paper", "hardware"])
def test_a_training_on_a_clip_keeps_the_learner(world, composed):
    env = mimic.env_config("panda7dof", world=world, learner={"locked": [7]})
    demonstrations = DemonstrationConfig("my clip.npz", count=8, held_out=2)
    trained = training_env(env, mimic.ArmConfig(model="clip.xml"), demonstrations)
    config = composed("train", *shlex.split(train_command(trained))[3:]).env
    assert config == trained and config.learner == env.learner and config.demonstrations == demonstrations
    assert config.world == env.world and (config.start == "nearest") == (world == "paper")
