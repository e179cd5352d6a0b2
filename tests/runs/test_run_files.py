"""The report and the metrics file of a run directory."""

import csv
import json
import os
import resource
import signal
import struct
import subprocess
import sys

import pytest
import tensorboardX

from mimic.runs.files import REPORT, write_report
from mimic.runs.metrics_log import MetricsLog
from tests.helpers.run_directories import rows_of


def test_a_metric_that_is_not_finite_prints_nothing(tmp_path, caplog):
    log = MetricsLog(tmp_path)
    log.write(1, {"quality/gap": float("nan"), "loss": float("inf")})
    log.close()
    assert rows_of(tmp_path) == [{"step": "1", "quality/gap": "nan", "loss": "inf"}] and not caplog.records


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
    rows = rows_of(tmp_path)
    assert rows[0] == {"step": "1", "old": "0.5", "wall_time_s": "2.0", "new": ""}
    assert rows[2] == {"step": "3", "old": "", "wall_time_s": "4.0", "new": "30.0"}
    assert {path.name for path in tmp_path.iterdir()} == {"metrics.csv", "tensorboard"}


def test_a_training_does_not_import_pytorch(tmp_path):
    """It takes four seconds where it is installed, and nothing needs it."""
    (tmp_path / "torch.py").write_text("raise RuntimeError('imported')")
    code = "import sys, mimic.trainers.ppo.trainer as _; from mimic.runs.metrics_log import MetricsLog; "
    code += f"from pathlib import Path; MetricsLog(Path({str(tmp_path)!r})).close(); assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | {"PYTHONPATH": str(tmp_path)})


def test_a_resumed_log_is_cut_to_the_checkpoint(tmp_path):
    log = MetricsLog(tmp_path)
    for step in (10, 20, 30):
        log.write(step, {"loss": 0.5})
    log.close()
    log = MetricsLog(tmp_path, first_step=20)
    log.write(20, {"loss": 0.25})
    log.close()
    assert [(row["step"], row["loss"]) for row in rows_of(tmp_path)] == [("10", "0.5"), ("20", "0.25")]


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


def test_a_full_disk_is_an_error_of_the_write(tmp_path):
    """Not one that a thread prints; by the maximum size of a file of this process."""
    log = MetricsLog(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (300, before[1]))
        with pytest.raises(OSError, match="File too large"):
            for step in range(20):
                log.write(step, {"loss": 0.5})
        log.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert [row["step"] for row in rows_of(tmp_path)][:2] == ["0", "1"]


def test_events_are_those_of_the_metrics(tmp_path):
    """In TensorBoard's format: for each record its length, a checksum, an event, and a checksum."""
    log = MetricsLog(tmp_path, first_step=2)
    log.write(2, {"quality/gap": 0.5})
    log.close()
    (file,) = (tmp_path / "tensorboard").iterdir()
    content, events, event_class = file.read_bytes(), [], tensorboardX.proto.event_pb2.Event
    while content:
        (size,) = struct.unpack("<Q", content[:8])
        events.append(event_class.FromString(content[12 : 12 + size]))
        content = content[16 + size :]
    version, start, scalar = events
    assert version.file_version == "brain.Event:2"
    assert (start.step, start.session_log.status) == (2, 1)  # hides what another file has from this step on
    assert (scalar.step, scalar.summary.value[0].tag, scalar.summary.value[0].simple_value) == (2, "quality/gap", 0.5)


@pytest.mark.parametrize("row", [b"2\xff\xfe,0.5\r\n", b"20,"], ids=["bytes", "half"])
def test_a_damaged_file_loses_its_damaged_rows_alone(tmp_path, row):
    (tmp_path / "metrics.csv").write_bytes(b"step,loss\r\n10,0.5\r\n" + row)
    log = MetricsLog(tmp_path, first_step=30)
    log.write(30, {"loss": 0.25})
    log.close()
    assert [row["step"] for row in rows_of(tmp_path)] == ["10", "30"]
