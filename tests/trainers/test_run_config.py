"""The config of a run directory, loaded again."""

import pytest
from omegaconf import OmegaConf

from mimic.metric.config import MetricConfig
from mimic.runs.files import CONFIG
from mimic.trainers.config import PPOSettings
from mimic.trainers.run_config import load_config
from tests.helpers.run_directories import write_run


@pytest.mark.parametrize(
    ("saved", "expected"),
    [
        ({"translation": 0.0, "correspondence": "overlap"}, ("merged", "chord_overlap", 0.0)),
        ({"translation": 0.3, "correspondence": "soft"}, ("merged", "soft", 0.3)),
        (None, ("merged", "chord_overlap", 0.0)),
    ],
)
def test_a_run_with_merged_links_keeps_its_metric(tmp_path, saved, expected):
    run_dir = write_run(tmp_path / "run", [0.1], env="panda4dof")
    content = OmegaConf.to_container(OmegaConf.load(run_dir / CONFIG))
    assert isinstance(content, dict)
    content["env"]["metric"] = saved or {}
    OmegaConf.save(OmegaConf.create(content), run_dir / CONFIG)
    metric = load_config(run_dir).env.metric
    assert (metric.links, metric.correspondence, metric.translation) == expected


def test_a_new_run_keeps_its_metric(tmp_path):
    metric = load_config(write_run(tmp_path / "run", [0.1], env="panda4dof")).env.metric
    assert metric == MetricConfig() and metric.links == "kept"


def test_an_old_run_keeps_its_critic_and_its_schedule(tmp_path):
    """Runs older than both fields: their checkpoints have a critic that does not observe the time."""
    run_dir = write_run(tmp_path / "run", [0.1], env="panda4dof")
    content = OmegaConf.load(run_dir / CONFIG)
    assert content.trainer.pop("timed_critic", True) is True
    content.trainer.pop("final_entropy_cost", None)
    OmegaConf.save(content, run_dir / CONFIG)
    settings = load_config(run_dir).trainer.resolve()
    assert isinstance(settings, PPOSettings)
    assert settings.timed_critic is False and settings.final_entropy_cost == 1
