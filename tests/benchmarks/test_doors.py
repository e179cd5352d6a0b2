"""The figure of the replays of doors."""

import json

import numpy as np
import pytest

from benchmarks.figures import doors
from benchmarks.transfer import ARMS


def test_doors_of_all_replays_are_drawn(tmp_path, monkeypatch):
    times = 240
    names = {"panda": "recorded"} | dict.fromkeys(ARMS, "mimic")
    for number, (name, method) in enumerate(names.items()):
        angles = np.linspace(0, 0.1 * number, times)
        result = {"door_rad": angles.tolist(), "hand_lag_mm": [5.0] * times, "success": number > 3}
        (tmp_path / f"replays_door_{name}_{method}.json").write_text(json.dumps([result]))
    drawn = []
    monkeypatch.setattr(doors.plt, "close", drawn.append)
    doors.main([str(tmp_path), "--out", str(tmp_path)])
    (figure,) = drawn
    door, lag = figure.axes
    assert [line.get_label() for line in door.lines[: len(names)]] == list(names)
    assert door.lines[5].get_ydata()[-1] == pytest.approx(0.5)
    assert [line.get_linestyle() for line in lag.lines] == ["--"] * 4 + ["-"] * 2
    assert (tmp_path / "doors.png").stat().st_size > 10_000
