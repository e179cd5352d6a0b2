"""The report and the metrics file of a run directory."""

import csv
import json

import pytest

from mimic.runs.files import REPORT, write_report
from mimic.runs.metrics_log import MetricsLog


def test_a_report_is_json_even_after_a_divergence(tmp_path):
    write_report(tmp_path, {"gap": {"train": float("nan"), "held_out": 0.5}, "worst": [float("inf"), 1]})
    text = (tmp_path / REPORT).read_text()
    assert "NaN" not in text  # which is not JSON, though Python reads it
    assert json.loads(text) == {"gap": {"train": None, "held_out": 0.5}, "worst": [None, 1]}


def test_metrics_of_another_version_keep_their_columns(tmp_path):
    """A run of another version continues with the columns of this one."""
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


def rows_of(run_dir):
    with (run_dir / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_resumed_log_is_cut_to_the_checkpoint(tmp_path):
    log = MetricsLog(tmp_path)
    for step in (10, 20, 30):
        log.write(step, {"loss": 0.5})
    log.close()
    log = MetricsLog(tmp_path, first_step=20)
    log.write(20, {"loss": 0.25})
    log.close()
    assert [(row["step"], row["loss"]) for row in rows_of(tmp_path)] == [("10", "0.5"), ("20", "0.25")]


def test_a_half_written_row_is_removed(tmp_path):
    log = MetricsLog(tmp_path)
    for step in (10, 20):
        log.write(step, {"loss": 0.5, "reward": 1.0})
    log.close()
    path = tmp_path / "metrics.csv"
    path.write_bytes(path.read_bytes()[:-7])
    log = MetricsLog(tmp_path, first_step=30)
    log.write(30, {"loss": 0.5, "reward": 1.0})
    log.close()
    assert [row["step"] for row in rows_of(tmp_path)] == ["10", "30"]


def test_a_row_that_cannot_be_written_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    log = MetricsLog(tmp_path)
    log.write(10, {"loss": 0.5})
    before = (tmp_path / "metrics.csv").read_bytes()

    class FullDisk(csv.DictWriter):
        def writerow(self, row):
            super().writerow({**row, "loss": 0.5})
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(csv, "DictWriter", FullDisk)
    with pytest.raises(OSError, match="No space left"):
        log.write(20, {"loss": 0.25})
    log.close()
    assert (tmp_path / "metrics.csv").read_bytes() == before


def test_a_damaged_file_loses_its_damaged_rows_alone(tmp_path):
    (tmp_path / "metrics.csv").write_bytes(b"step,loss\r\n10,0.5\r\n2\xff\xfe,0.5\r\n")
    log = MetricsLog(tmp_path, first_step=30)
    log.write(30, {"loss": 0.25})
    log.close()
    assert [row["step"] for row in rows_of(tmp_path)] == ["10", "30"]
