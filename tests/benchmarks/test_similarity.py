"""`python -m benchmarks.similarity`: its optimiser is `imitate_pose`'s, and its tables say what the rows say."""

import functools

import jax
import numpy as np
import pytest

import mimic
from benchmarks import similarity as benchmark
from benchmarks import similarity_poses as poses
from benchmarks import similarity_summary as summary
from mimic.metric.kinematics import link_state_table
from mimic.metric.similarity import MEASURES
from mimic.retargeting.pose import shared_joints


def test_all_single_and_double_locks_and_two_more():
    pairs = benchmark.locked_pandas()
    assert len(pairs) == 7 + 21 + 2
    assert sum(summary.is_lock({"pair": pair.name}) for pair in pairs) == 28
    assert {pair.name for pair in pairs} >= {*benchmark.SUBSET, benchmark.FULL}


def test_arms_that_are_not_there_are_named(tmp_path):
    pairs, missing = benchmark.other_arms(tmp_path)
    assert pairs == [] and missing == list(benchmark.WANTED)


def test_the_optimiser_finds_what_imitate_pose_finds():
    expert, learner = mimic.planar_arm([0.25] * 4), mimic.planar_arm([1.0, 0.6, 0.4])  # of other size too
    qpos = np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 4)).astype(np.float32)
    matrix = mimic.arc_length_correspondence(expert, learner)
    weights = mimic.DistanceWeights(0.5, 1.0)
    best = mimic.imitate_pose(expert, learner, qpos, matrix, weights)
    states = link_state_table(expert, qpos, np.zeros_like(qpos))
    found = poses.best_poses(poses.arm_data(learner), states, matrix, 0.5, shared_joints(expert, learner, qpos))
    assert not np.any(found[:, 3:])  # padding

    def distance(pose, learner_pose):
        states = mimic.link_states(expert, pose), mimic.link_states(learner, learner_pose)
        return float(mimic.embodiment_distance(*states, matrix, weights))

    left = [distance(*pair) for pair in zip(qpos, found[:, :3], strict=True)]
    # The random starts differ, so a pose may end in another minimum: on average that must not matter.
    assert np.mean(left) < 1.01 * float(best.distance.mean())


def test_closed_form_derivatives(x64):
    """Against automatic differentiation, for an arm with fewer links than joints and one link that nothing moves."""
    expert, learner = mimic.panda(), mimic.panda(locked=(1, 4), links="merged")
    rng = np.random.default_rng(0)
    data = jax.tree.map(lambda x: x.astype(float) if x.dtype == np.float32 else x, poses.arm_data(learner))
    states = link_state_table(expert, rng.uniform(-3, 3, 7), np.zeros(7))
    matrix = np.pad(np.asarray(mimic.overlap_correspondence(expert, learner)), ((0, 0), (0, 7 - learner.num_links)))
    pair = (np.asarray(x, float) for x in (states.position, states.direction))
    derivatives = functools.partial(poses._derivatives, data, *pair, matrix, 0.7)
    qpos = np.pad(rng.uniform(-3, 3, 5), (0, 2))
    found, value = derivatives(qpos), lambda q: derivatives(q).value
    np.testing.assert_allclose(found.gradient, jax.grad(value)(qpos), atol=1e-12)
    hessian = jax.hessian(value)(qpos)
    for i, entries in enumerate(found.hessian):
        np.testing.assert_allclose(entries, hessian[i, : i + 1], atol=1e-10)
    weights = mimic.DistanceWeights(0.7, 1.0)
    exact = mimic.embodiment_distance(
        states, mimic.link_states(learner, qpos[:5]), matrix[:, : learner.num_links], weights
    )
    # Float32 arm data and link states, and the smoothed kink of positions.
    np.testing.assert_allclose(found.value / (7 * learner.num_links), exact, rtol=1e-4)


def row(pair, method, values, kind="pd"):
    measures = {name: [value, 2 * value] for name, value in zip(MEASURES, values, strict=True)}
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


def test_rows_are_read_as_they_are_written():
    rows = [{**entry, "poses": 3} for entry in ROWS] + [{"pair": "a to panda", "set": "pd", "failed": "no goal"}]
    assert summary.from_lines(summary.to_lines(rows)) == rows


def test_ratios_and_cases_lost():
    compared = summary.compare(ROWS, summary.is_lock, "copy_joints", ("pd",))
    assert list(compared) == ["copy_joints", "kept overlap 1", "kept overlap 2"]
    first, second = (compared[f"kept overlap {weight}"] for weight in (1, 2))
    assert first["cases"] == 2
    assert first["centre_line_distance"] == {"ratio": 0.5, "lost": 0}
    assert first["hand_position_error"] == {"ratio": 1.04, "lost": 0}  # within 1.05
    assert second["hand_position_error"]["lost"] == 1
    assert second["centre_line_distance"] == {"ratio": 0.5, "lost": 1}  # where copying is exact


def test_the_front_leaves_out_what_another_beats():
    compared = summary.compare(ROWS, summary.is_lock, "copy_joints", ("pd",))
    assert summary.pareto_front(compared) == ["kept overlap 1"]


@pytest.mark.parametrize("rows", [ROWS, []])
def test_tables_and_plot(rows, tmp_path, capsys):
    summary.print_tables(rows)
    if rows:
        assert "2 cases" in capsys.readouterr().out
        summary.save_plot(rows, tmp_path / "front.png")
        assert (tmp_path / "front.png").stat().st_size > 0
