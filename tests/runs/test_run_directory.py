"""What a run directory holds."""

import csv
import json

import pytest
from omegaconf import OmegaConf

from mimic.metric.config import MetricConfig
from mimic.runs.files import CONFIG, REPORT, write_report
from mimic.runs.metrics_log import MetricsLog
from mimic.trainers.run_config import load_config
from tests.helpers.run_directories import write_run


def test_a_report_is_json_even_after_a_divergence(tmp_path):
    write_report(tmp_path, {"gap": {"train": float("nan"), "held_out": 0.5}, "worst": [float("inf"), 1]})
    text = (tmp_path / REPORT).read_text()
    assert "NaN" not in text  # which is not JSON, though Python reads it
    assert json.loads(text) == {"gap": {"train": None, "held_out": 0.5}, "worst": [None, 1]}


def test_metrics_of_another_version_keep_their_columns(tmp_path):
    """A run that another version began goes on with columns of its own."""
    (tmp_path / "metrics.csv").write_text("step,old,wall_time_s\n1,0.5,2.0\n")
    log = MetricsLog(tmp_path)
    for step in (2, 3):
        log.write(step, {"new": 10.0 * step, "wall_time_s": 4.0})
    log.close()
    with (tmp_path / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[0] == {"step": "1", "old": "0.5", "wall_time_s": "2.0", "new": ""}
    assert rows[2] == {"step": "3", "old": "", "wall_time_s": "4.0", "new": "30.0"}
    assert {path.name for path in tmp_path.iterdir()} == {"metrics.csv", "tensorboard"}


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
