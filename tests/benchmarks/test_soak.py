"""`python -m benchmarks.soak`: slopes with their confidence, and a short soak."""

import math
import os

import numpy as np
import pytest

from benchmarks import soak
from benchmarks.common.process_samples import sample, trends
from benchmarks.common.trend import trend

HOURS = np.linspace(0.0, 2.0, 600)


def test_noise_and_a_warm_up_are_flat():
    random = np.random.default_rng(1)
    values = 400 - 100 * np.exp(-HOURS / 0.05) + random.normal(0, 3, len(HOURS))
    assert trend(HOURS.tolist(), values.tolist()).is_flat


def test_constant_values_are_flat_and_few_have_no_slope():
    assert trend([0, 1, 2, 3, 4], [7.0] * 5) == (0, 0, 0)
    assert math.isnan(trend([0, 1], [0, 1]).slope) and not trend([], []).is_flat


def test_a_process_is_sampled(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").write_bytes(b"x" * 2**20)
    row = sample(os.getpid(), tmp_path)
    assert row["disk_mib"] == 1 and row["files"] == 1 and row["memory_mib"] > 10
    with (tmp_path / "folder" / "file").open():
        assert sample(os.getpid())["handles"] == row["handles"] + 1


def test_the_summary_counts_the_memory_of_each_evaluation(tmp_path):
    samples = [{"time_s": 10.0 * i, **dict.fromkeys(soak.SAMPLED, 5.0), "memory_mib": 400 + i / 10} for i in range(100)]
    speeds = [{"time_s": float(i), "steps_per_s": 100.0} for i in range(991)]
    result = soak.summary({"samples": samples, "speeds": speeds}, tmp_path)
    memory = next(row for row in result["trends"] if row["what"] == "memory_mib")
    assert memory["per_hour"] == pytest.approx(36) and not memory["flat"]
    assert result["memory_kib_per_evaluation"] == pytest.approx(36 * 0.275 / 991 * 1024, rel=1e-3)
    assert trends(samples, ["handles"])[0]["flat"]
