"""`python -m benchmarks.rollout`, and how benchmarks take times."""

import jax.numpy as jnp
import pytest

import mimic
from benchmarks import rollout
from benchmarks.common.timing import time_program


def test_the_memory_of_a_function_is_known():
    timing = time_program(lambda x: jnp.sin(x) * 2, jnp.ones(1000))
    assert timing.median > 0
    assert timing.bytes >= 8000  # a thousand input and a thousand output numbers
    assert set(timing.summary()) == {"compile_s", "median_ms", "spread"}


@pytest.mark.slow
def test_only_the_cases_asked_for_are_measured():
    rows = list(rollout.run(["panda4dof"], [16], ["fused", "reward", "observation", "C MuJoCo, all cores"]))
    assert [(row["group"], row["case"]) for row in rows] == [
        ("physics", "fused"),
        ("physics", "C MuJoCo, all cores"),
        ("environment", "fused"),
        ("part", "reward"),
        ("part", "observation"),
    ]
    assert all(row["steps_per_s"] > 0 for row in rows)
    assert rows[0]["bytes_per_arm"] > 0


@pytest.mark.slow
def test_a_peer_that_cannot_run_says_why(monkeypatch):
    def out_of_memory(*_):
        raise RuntimeError("no room\nand more")

    monkeypatch.setattr(mimic, "make", lambda *_, **__: None)
    monkeypatch.setitem(rollout.CASES["physics"], "mjx.Data carried", out_of_memory)
    (row,) = rollout.run(["planar4dof"], [16], ["mjx.Data carried"])
    assert row["failed"] == "RuntimeError: no room"


@pytest.mark.slow
@pytest.mark.parametrize("group, case", [("part", "new episode")])
def test_peers_run(group, case):
    env = mimic.make("panda4dof", demonstrations={"count": 1, "held_out": 1})
    assert rollout.CASES[group][case](env, 16).median > 0


@pytest.mark.slow
@pytest.mark.parametrize("group, case", [("physics", "mjx"), ("physics", "mjx.Data carried"), ("environment", "stock")])
def test_peers_on_mjx_run(group, case):
    env = mimic.make("panda4dof", demonstrations={"count": 1, "held_out": 1})
    assert rollout.CASES[group][case](env, 8).median > 0
