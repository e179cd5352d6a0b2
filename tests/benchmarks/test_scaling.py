"""`python -m benchmarks.scaling`."""

import pytest

from benchmarks import scaling

OF_ONE = {"num_envs": 16, "batch_size": 16, "num_timesteps": 3000}


def test_a_run_sees_so_many_devices(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--of-the-user")
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert scaling.environment(2, 1, "gpu")["CUDA_VISIBLE_DEVICES"] == "0,1"
    flags = "--of-the-user --xla_force_host_platform_device_count"
    assert scaling.environment(2, 1, "cpu")["XLA_FLAGS"] == f"{flags}=2"
    assert scaling.environment(2, 2, "cpu")["XLA_FLAGS"] == f"{flags}=1"
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5,7")
    assert scaling.environment(2, 2, "gpu")["CUDA_VISIBLE_DEVICES"] == "3,5"


def test_weak_scaling_multiplies_and_the_speed_leaves_out_what_compiled(tmp_path, monkeypatch):
    def train(run_dir, arguments, env):
        run_dir.mkdir()
        (run_dir / "metrics.csv").write_text("step,training/sps\n1,1\n2,100\n3,110\n4,120\n")
        report = {"optimality_gap": {}, "env_steps": 4}
        return {"report": report, "process_wall_s": 1.0, "arguments": arguments}

    monkeypatch.setattr(scaling, "train", train)
    row = scaling.measure("weak", 2, 1, 0, [], OF_ONE)
    assert row["arguments"] == ["trainer.num_envs=32", "trainer.batch_size=32", "trainer.num_timesteps=6000", "seed=0"]
    assert scaling.measure("strong", 2, 1, 0, [], OF_ONE)["arguments"][0] == "trainer.num_envs=16"
    assert (row["steps_per_s"], row["spread"]) == (110.0, pytest.approx(10 / 110, abs=1e-4))


def test_efficiency_is_relative_to_the_fewest_devices():
    rates = {("weak", 2, 1): 200.0, ("weak", 4, 4): 360.0, ("weak", 4, 1): 300.0, ("strong", 2, 1): 100.0}
    results = [
        {"scaling": kind, "devices": devices, "processes": processes, "seed": seed, "steps_per_s": rate + seed - 1}
        | {"optimality_gap": {"train": 0.01 * seed}}
        for (kind, devices, processes), rate in rates.items()
        for seed in range(3)
    ]
    rows = scaling.summary(results)
    assert [(row["scaling"], row["devices"], row["processes"], row["efficiency"]) for row in rows] == [
        ("weak", 2, 1, 1.0), ("weak", 4, 1, 0.75), ("weak", 4, 4, 0.9), ("strong", 2, 1, 1.0),
    ]  # fmt: skip
    assert rows[0]["gap"] == pytest.approx(0.01) and rows[0]["gap_deviation"] == pytest.approx(0.01)
