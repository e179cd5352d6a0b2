"""`python -m benchmarks.similarity`: its pairs, and its tables say what the rows say."""

import numpy as np
import pytest

import mimic
from benchmarks import similarity as benchmark
from benchmarks.figures import similarity_front as summary
from mimic.arms.arm import ArmConfig
from mimic.envs.config import EnvConfig
from mimic.metric.similarity import MEASURES


def test_all_single_and_double_locks_and_two_more():
    pairs = benchmark.locked_pandas()
    assert len(pairs) == 7 + 21 + 2
    assert sum(summary.is_lock({"pair": pair.name}) for pair in pairs) == 28
    assert {pair.name for pair in pairs} >= {benchmark.FULL}


@pytest.mark.slow
def test_one_compiled_function_serves_all_weights():
    expert, learner = (ArmConfig(model="planar", link_lengths=lengths) for lengths in ([0.5, 0.5], [0.6, 0.4]))
    qpos = np.random.default_rng(0).uniform(-np.pi, np.pi, (5, 2))
    posed = benchmark.optimal_poses(EnvConfig(expert=expert, learner=learner), "kept", "arc_length", (0.0, 2.0), qpos)
    for weight, (name, arm, poses) in zip((0.0, 2.0), posed, strict=True):
        assert name == f"kept arc_length {weight:g}"
        arms = mimic.planar_arm([0.5, 0.5]), arm
        matrix, weights = mimic.arc_length_correspondence(*arms), mimic.DistanceWeights(weight, 1.0)
        best = mimic.imitate_pose(*arms, qpos.astype(np.float32), matrix, weights)
        np.testing.assert_allclose(np.cos(poses), np.cos(best.qpos), atol=1e-3)  # float32, weights traced or constant


def row(pair, method, values, kind="computed_torque"):
    measures = {name: value for name, value in zip(MEASURES, (*values, values[-1]), strict=True)}
    return {"pair": pair, "set": kind, "method": method, "measures": measures}


ROWS = [
    row("panda -1", "copy_joints", (0.1, 10, 0.2, 0.1, 40)),
    row("panda -1", "kept overlap 1", (0.05, 5, 0.2, 0.104, 20)),
    row("panda -1", "kept overlap 2", (0.05, 6, 0.2, 0.106, 20)),
    row("panda -7", "copy_joints", (0, 0, 0, 0, 0)),  # exact: no ratio
    row("panda -7", "kept overlap 1", (0.0001, 0.01, 0, 0, 0.01)),
    row("panda -7", "kept overlap 2", (0.01, 1, 0, 0, 1)),
    row("panda -3,6,7", "copy_joints", (1, 1, 1, 1, 1)),  # none of the 28
    row("panda -1", "merged overlap 1", (0, 0, 0, 0, 0)),  # not on all cases
]


LOCKS = [row for row in ROWS if summary.is_lock(row)]


def test_ratios_and_cases_lost():
    compared = summary.compare(LOCKS, "copy_joints")
    assert list(compared) == ["copy_joints", "kept overlap 1", "kept overlap 2"]
    first, second = (compared[f"kept overlap {weight}"] for weight in (1, 2))
    assert first["cases"] == 2
    assert first["centre_line_distance"] == {"ratio": 0.5, "lost": 0}
    assert first["hand_position_error"] == {"ratio": 1.04, "lost": 0}  # within 1.05
    assert second["hand_position_error"]["lost"] == 1
    assert second["centre_line_distance"] == {"ratio": 0.5, "lost": 1}  # where copying is exact


def test_tables(capsys):
    summary.print_tables([])
    summary.print_tables(ROWS)
    assert "locks, demonstrations" in capsys.readouterr().out
