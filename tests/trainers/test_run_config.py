"""The config of a run directory, loaded again."""

import pytest
from omegaconf import OmegaConf

from mimic.arms.arm import ArmConfig
from mimic.metric.config import MetricConfig
from mimic.runs.files import CONFIG
from mimic.trainers.config import PPOConfig
from mimic.trainers.run_config import load_config
from tests.helpers import original_model
from tests.helpers.run_directories import write_run


def test_a_new_run_keeps_its_metric(tmp_path):
    metric = load_config(write_run(tmp_path / "run", [0.1], env="panda4dof")).env.metric
    assert metric == MetricConfig() and metric.links == "kept"


@pytest.mark.parametrize("role", ["expert", "learner"])
def test_an_old_run_of_an_arm_from_a_file_keeps_its_links(tmp_path, role):
    """The number of links is part of the observations that its policy was trained on."""
    file = tmp_path / "arm.xml"
    file.write_text(original_model.ur_like())
    run_dir = write_run(tmp_path / "run", [0.1], env="pair")
    content = OmegaConf.load(run_dir / CONFIG)
    content.env[role].model = str(file)
    num_links = {}
    for age in ("new", "old"):
        if age == "old":
            del content.env.expert.base_segment, content.env.learner.base_segment
        OmegaConf.save(content, run_dir / CONFIG)
        arms = load_config(run_dir).env.build_arms()
        num_links[age] = getattr(arms, role).embodiment.num_links
    assert num_links == {"new": 7, "old": 6}
    built_in = {"expert": "learner", "learner": "expert"}[role]
    assert getattr(load_config(run_dir).env, built_in) == ArmConfig()


@pytest.mark.parametrize(("saved", "expected"), [(None, "mjx"), ("mjx", "mjx"), ("fused", "fused")])
def test_an_old_run_keeps_its_physics(tmp_path, saved, expected):
    """Runs older than the field were trained on MJX."""
    run_dir = write_run(tmp_path / "run", [0.1], env="panda4dof")
    content = OmegaConf.load(run_dir / CONFIG)
    del content.env.physics
    if saved:
        content.env.physics = saved
    OmegaConf.save(content, run_dir / CONFIG)
    assert load_config(run_dir).env.physics == expected


def test_an_old_run_keeps_its_critic_and_its_schedule(tmp_path):
    """Runs older than both fields: their checkpoints have a critic that does not observe the time."""
    run_dir = write_run(tmp_path / "run", [0.1], env="panda4dof")
    content = OmegaConf.load(run_dir / CONFIG)
    assert content.trainer.pop("timed_critic", True) is True
    content.trainer.pop("final_entropy_cost", None)
    OmegaConf.save(content, run_dir / CONFIG)
    settings = load_config(run_dir).trainer.resolve()
    assert isinstance(settings, PPOConfig)
    assert settings.timed_critic is False and settings.final_entropy_cost == 1
