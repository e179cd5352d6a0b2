"""What a run directory holds."""

import csv
import json

from mimic.runs.files import REPORT, write_report
from mimic.runs.metrics_log import MetricsLog


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
