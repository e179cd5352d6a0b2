"""`python -m benchmarks.training`."""

import jax
import pytest

from benchmarks import training
from benchmarks.common.processes import time_to_goal
from benchmarks.common.record import print_table
from mimic.commands import cli


@pytest.mark.parametrize(
    "gaps, reached",
    [
        ([0.5, 0.02, 0.05, 0.02, 0.01, 0.02, 0.3], 3.0),  # the first time did not last
        ([0.5, 0.4, 0.3, 0.01], 3.0),  # and then it ended
        ([0.5, 0.01, 0.03], None),
    ],
)
def test_the_goal_is_reached_when_it_is_held(gaps, reached, tmp_path):
    rows = [f"{step},{gap},{step}.0" for step, gap in enumerate(gaps)]
    (tmp_path / "metrics.csv").write_text("\n".join(["step,quality/optimality_gap.train,wall_time_s", *rows]))
    assert time_to_goal(tmp_path, "optimality_gap.train", 0.02) == reached


@pytest.mark.slow  # two runs as processes of their own
def test_a_case_runs_cold_and_warm(monkeypatch):
    small = (
        "env=planar4dof", "env.demonstrations.count=2", "env.demonstrations.held_out=1",
        "trainer.preset=cpu", "trainer.num_timesteps=5000", "trainer.num_envs=16", "trainer.batch_size=16",
        "trainer.num_minibatches=2", "trainer.num_updates_per_batch=1", "trainer.evaluations=1",
    )  # fmt: skip
    monkeypatch.setitem(training.CASES, "small", training.Case(1e9, " ".join(small)))
    cold, warm = training.run_case("small", 1, ("cold", "warm"))
    assert (cold["start"], warm["start"]) == ("cold", "warm")
    assert 0 < cold["to_goal_s"] < cold["process_wall_s"] + 1
    assert warm["report"]["optimality_gap"] == cold["report"]["optimality_gap"]
    print_table([cold, warm], training.COLUMNS)


def test_cases_have_arguments_that_the_command_takes():
    import hydra

    cli._register_schemas()
    with hydra.initialize_config_module("mimic.conf", version_base="1.3"):
        for case in training.CASES.values():
            for on in case.on.values() or [""]:
                hydra.compose("train", f"{case.arguments} {on}".split())
    assert jax.default_backend() in training.CASES["one_demonstration"].on
