"""Resolved configs of trainers."""

import pytest

import mimic
from mimic.trainers.config import PoseMapperConfig, PPOConfig, TrainConfig
from mimic.trainers.make import make_trainer
from mimic.trainers.presets import PPO_PRESETS


def test_a_run_with_a_target_evaluates_more_often():
    usual, targeted = (PPOConfig(target_gap=gap).resolve("cpu").evaluations for gap in (0.0, 0.02))
    assert usual and targeted
    assert usual == PPO_PRESETS["cpu"]["evaluations"] and targeted > usual
    assert PPOConfig(target_gap=0.02, evaluations=3).resolve("cpu").evaluations == 3


def test_presets_follow_the_backend_and_the_environment():
    config = PPOConfig()
    envs = (
        mimic.env_config("panda4dof"),
        mimic.env_config("panda_family"),
        mimic.env_config("panda4dof", world="nominal"),
    )
    names = [config.resolve(backend, env=env).preset for env in envs for backend in ("cpu", "gpu")]
    assert names == ["cpu", "gpu", "any_arm_cpu", "any_arm", "inner_loop_cpu", "inner_loop"]
    family = TrainConfig(mimic.env_config("panda_family"), PPOConfig())
    assert family.resolve().trainer.network == "joints"  # type: ignore[attr-defined] - the settings of PPO
    mapper = TrainConfig(mimic.env_config("panda_family"), PoseMapperConfig())
    assert mapper.resolve("gpu").trainer.preset == "any_arm"


def test_the_network_of_joints_needs_a_drawn_learner():
    config = TrainConfig(mimic.env_config("planar4dof"), PPOConfig(network="joints"))
    with pytest.raises(ValueError, match="trainer.network: expected mlp for one learner, got joints"):
        make_trainer(config, None)
