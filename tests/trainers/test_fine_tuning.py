"""The config of a training that goes on with one of many arms."""

import pytest

from mimic.envs.config import ArmsConfig
from mimic.envs.family import arms_config
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.fine_tuning import fine_tuned, with_one_learner
from mimic.trainers.run_config import save_config
from tests.helpers.run_directories import write_run
from tests.helpers.untrained_run import FAMILY, family, untrained_run


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return untrained_run(tmp_path_factory.mktemp("runs") / "run", family())


def requested(init, **fields):
    return TrainConfig(family(), PPOConfig(), init=str(init), learner="panda", **fields)


@pytest.mark.slow
def test_the_learner_is_the_only_arm(run_dir):
    overrides = [f"init={run_dir}", "learner=panda", "seed=3", "trainer.num_timesteps=1000"]
    config = fine_tuned(requested(run_dir, seed=3, run_dir="runs/new"), overrides)
    arms = config.env.arms
    assert arms == ArmsConfig(locked_fraction=1.0, most_locked=0)
    assert config.env.name == "panda_family-panda" and config.env.learner.model == "panda"
    assert config.env.learner.armature == 0.1 and config.env.horizon == FAMILY["horizon"]
    assert isinstance(config.trainer, PPOConfig)
    assert config.trainer.num_timesteps == 1000 and config.trainer.hidden_layers == [8]
    assert (config.seed, config.run_dir, config.init, config.learner) == (3, "runs/new", str(run_dir), "panda")


@pytest.mark.parametrize(
    "override", ["env.horizon=5", "env=any_arm", "trainer.hidden_layers=[4]", "trainer.preset=gpu"]
)
def test_what_the_policy_was_trained_with_stays(run_dir, override):
    with pytest.raises(ValueError, match="learner: expected overrides of the length and rates of the trainer only"):
        fine_tuned(requested(run_dir), [override])


def test_the_reward_stays(tmp_path):
    for reward in ("distance", "relative"):
        save_config(tmp_path, TrainConfig(family(arms={"reward": reward}), PPOConfig(preset="any_arm_cpu").resolve()))
        assert arms_config(fine_tuned(requested(tmp_path), []).env).reward == reward


def test_a_run_of_one_learner_is_rejected(tmp_path):
    with pytest.raises(ValueError, match="learner: expected init=DIR of a run of many arms, got one of env=planar4dof"):
        fine_tuned(requested(write_run(tmp_path / "run", [0.1])), [])


def test_a_learner_needs_a_run_to_start_from():
    with pytest.raises(ValueError, match="learner: expected with init=DIR of a run of many arms, got 'panda' without"):
        TrainConfig(learner="panda")


def test_an_environment_of_one_learner():
    env = with_one_learner(family(), "panda", [2, 4])
    assert env.kind == "one_arm" and env.physics == "auto" and env.learner.locked == [2, 4]
    assert env.build_arms().learner.embodiment.num_joints == 5
    with pytest.raises(ValueError, match="panda_pair: expected a serial arm, got a tree of 2 chains"):
        with_one_learner(family(), "panda_pair", [])
