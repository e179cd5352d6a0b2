"""`python -m benchmarks.costs`: its motions, its weights, and the quantities of its rows."""

from types import SimpleNamespace

import numpy as np
import pytest

import mimic
from benchmarks import costs as benchmark
from mimic.metric.similarity import MEASURES


@pytest.mark.slow
def test_rows_say_what_the_learner_does(monkeypatch):
    """A learner that copies the free joints: its hand is off, and a step of its motion is that of the expert."""
    free = [0, 1, 3, 4]

    def copy(expert, learner, motion, **_):
        return SimpleNamespace(qpos=motion[:, free], distance=np.full(len(motion), 0.5))

    monkeypatch.setattr(mimic, "imitate_trajectory", copy)
    kinds = {row["motions"]: row for row in benchmark.measure(2, ["none"])}
    motions = benchmark.random_motions(mimic.panda(limits="hardware"), 2)[..., free]
    row = kinds["random"]
    np.testing.assert_allclose(row["step_rms"], np.sqrt(np.mean(np.diff(motions, axis=1) ** 2)), rtol=1e-5)
    assert set(row["similarity"]) == set(MEASURES) and row["similarity"]["hand_position_error"] > 0.01
    assert row["distance"] == 0.5 and 0 < row["below_floor"] < 1 and kinds["demonstrations"]["below_floor"] == 0
