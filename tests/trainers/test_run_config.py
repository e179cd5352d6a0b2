"""The config of a run directory, as it is read again."""

import pytest
from omegaconf import OmegaConf

from mimic.metric.config import MetricConfig
from mimic.runs.files import CONFIG
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
def test_a_run_from_before_links_were_kept_has_the_metric_of_its_time(tmp_path, saved, expected):
    run_dir = write_run(tmp_path / "run", [0.1], env="panda4dof")
    content = OmegaConf.to_container(OmegaConf.load(run_dir / CONFIG))
    assert isinstance(content, dict)
    content["env"]["metric"] = saved or {}
    OmegaConf.save(OmegaConf.create(content), run_dir / CONFIG)
    metric = load_config(run_dir).env.metric
    assert (metric.links, metric.correspondence, metric.translation) == expected


def test_a_run_of_today_keeps_its_metric(tmp_path):
    metric = load_config(write_run(tmp_path / "run", [0.1], env="panda4dof")).env.metric
    assert metric == MetricConfig() and metric.links == "kept"
