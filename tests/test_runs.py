"""What a run directory holds."""

import json

from mimic.trainers import runs


def test_a_report_is_json_even_after_a_divergence(tmp_path):
    runs.write_report(tmp_path, {"gap": {"train": float("nan"), "held_out": 0.5}, "worst": [float("inf"), 1]})
    text = (tmp_path / runs.REPORT).read_text()
    assert "NaN" not in text  # which is not JSON, though Python reads it
    assert json.loads(text) == {"gap": {"train": None, "held_out": 0.5}, "worst": [None, 1]}
