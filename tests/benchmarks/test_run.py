"""`python -m benchmarks.run`: what it starts, and the table of targets."""

import json
import sys

import pytest

from benchmarks import run
from benchmarks.common import targets
from tests.helpers import pages


def write(folder, name, benchmark, backend="gpu", date="2026-01-01", **content):
    results = {"benchmark": benchmark, "date": date, "hardware": {"backend": backend}, **content}
    (folder / name).write_text(json.dumps(results))


def target(quantity, backend="gpu"):
    return next(row for row in targets.TARGETS if row.quantity == quantity and row.backend == backend)


def measured(folder, *which):
    return targets.find(target(*which), targets.read_folder(folder))


def test_the_newest_file_that_holds_it_counts(tmp_path):
    row = {"sweep": "batch", "method": "mimic", "quantity": "value"}
    write(tmp_path, "a.json", "kernel", results=[{**row, "pairs_per_s": 1e9}, {**row, "pairs_per_s": 2e10}])
    write(tmp_path, "b.json", "kernel", date="2026-01-02", results=[{**row, "pairs_per_s": 3e10}])
    write(tmp_path, "c.json", "kernel", date="2026-01-03", results=[{**row, "failed": "out of memory"}])
    write(tmp_path, "d.json", "kernel", "cpu", date="2026-01-04", results=[{**row, "pairs_per_s": 1e6}])
    (tmp_path / "e.json").write_text("no results")
    assert measured(tmp_path, "kernel, pairs/s") == (3e10, "b.json")
    assert measured(tmp_path, "kernel with gradient, pairs/s") is None


def test_each_benchmark_is_read_as_it_is_written(tmp_path):
    physics = {"env": "panda7dof", "group": "physics", "case": "fused"}
    write(tmp_path, "rollout.json", "rollout", rows=[{**physics, "arms": 8192, "steps_per_s": 7e7}])
    processes = [{"what": "import jax", "median_s": 1.0}, {"what": "import mimic", "median_s": 2.25}]
    write(tmp_path, "startup.json", "startup", "cpu", rows=processes)
    write(tmp_path, "ppo.json", "ppo", rows=[{"case": "mimic, fused", "steps_per_s": 3e6}])
    weak = {"scaling": "weak", "devices": 8, "efficiency": 0.85}
    write(tmp_path, "scaling.json", "scaling", rows=[weak, {**weak, "scaling": "strong", "efficiency": 0.2}])
    start = {"case": "one_demonstration", "start": "cold"}
    write(tmp_path, "training.json", "training", runs=[{**start, "to_goal_s": 12.0}, {**start, "to_goal_s": None}])
    pairs = [{"methods": {"newton": {"poses_per_second": rate}}} for rate in (3e6, 2e6)]
    write(tmp_path, "pose.json", "pose", results=pairs)
    mapper = [
        {"preset": "large", "to_goal_s": 9.0},
        {"preset": "paper", "to_goal_s": None},
    ]
    write(tmp_path, "pose_mapper.json", "pose_mapper", runs=mapper)
    candidate = {"engine": "fused", "integrator": "rk4", "substeps": 10, "error_mm": {"end": {"p95": 0.9}}}
    write(tmp_path, "physics.json", "physics", results=[{"env": "panda7dof", "candidates": [candidate]}])
    gaps = {"panda4dof": [{"optimality_gap": {"train": gap, "held_out": 0.05}} for gap in (0.01, 0.03)]}
    write(tmp_path, "study.json", "dynamic_imitation", results=gaps)
    expected = {
        ("import of mimic beyond jax", "cpu"): (1.25, True),
        ("physics of 8192 arms, steps/s", "gpu"): (7e7, True),
        ("PPO with learning, env steps/s", "gpu"): (3e6, True),
        ("PPO on 8 GPUs, efficiency", "gpu"): (0.85, False),
        ("to 2 % gap, cold", "gpu"): (float("inf"), False),
        ("optimal poses/s, slowest pair", "gpu"): (2e6, True),
        ("pose mapper within 2 %, slowest", "gpu"): (9.0, True),
        ("tip after 5 s, 95 of 100", ""): (0.9, True),
        ("gap, 4-DOF", ""): (0.02, True),
        ("gap, 4-DOF, held out", ""): (0.05, False),
    }
    for which, (value, met) in expected.items():
        entry = measured(tmp_path, *which)
        assert entry is not None, which
        assert entry[0] == pytest.approx(value) and target(*which).met(entry[0]) is met, which


def test_the_table_says_where_each_row_is_from_and_what_makes_the_others(tmp_path):
    write(tmp_path, "ppo_h200.json", "ppo", rows=[{"case": "mimic, fused", "steps_per_s": 1.5e6}])
    rows = {row["quantity"]: row for row in targets.table(targets.read_folder(tmp_path))}
    ppo = rows["PPO with learning, env steps/s"]
    assert (ppo["measured"], ppo["met"], ppo["from"]) == (1.5e6, "missed", "ppo_h200.json")
    assert rows["kernel, pairs/s"]["from"] == "python -m benchmarks.run kernel"


def test_the_results_of_this_repository_are_read(request):
    files = targets.read_folder(request.config.rootpath / "benchmarks" / "results")
    quantities = {row.quantity for row in targets.TARGETS if targets.find(row, files)}
    assert {"gap, 7-DOF", "optimal poses/s, slowest pair", "tip after 5 s, 95 of 100"} <= quantities


def test_benchmarks_are_started_with_what_they_take(tmp_path, monkeypatch):
    assert {row.benchmark for row in targets.TARGETS} <= set(run.BENCHMARKS)
    for name in run.BENCHMARKS:
        started = run.command(name, tmp_path / f"{name}_h200.json", "gpu", 4, "abc")
        assert started[1:5] == ["-m", f"benchmarks.{name}", "--out", str(tmp_path / f"{name}_h200.json")]
        pages.check(["python", *started[1:]], monkeypatch)
    assert "--devices 1 2 4" in " ".join(run.command("scaling", tmp_path / "x.json", "gpu", 4, None))
    assert run.device_name("NVIDIA H200") == "h200" and run.device_name("cpu") == "cpu"


def test_an_unknown_benchmark_is_rejected(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["run", "nothing", "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit):
        run.main()
    assert "unknown benchmark 'nothing'; valid are all, startup, kernel" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
