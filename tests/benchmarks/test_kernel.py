"""`python -m benchmarks.kernel`: all that can run without a GPU, on few pairs."""

import pytest

from benchmarks import kernel


@pytest.fixture(scope="module")
def rows():
    arms = kernel.planar_pair(3)
    methods = "mimic", "composition", "matrices"
    return [row for method in methods for row in kernel.sweep("links", {3: (arms, 8)}, method)]


@pytest.mark.slow
def test_all_methods_compute_the_same(rows):
    assert {(row["method"], row["quantity"]) for row in rows} >= {("mimic", "all"), ("matrices", "gradient")}
    for row in rows:
        assert row["pairs_per_s"] > 0
        assert all(0 <= error < 1e-5 for error in row["largest_error"].values())  # float32 against double precision


def test_a_method_that_fails_says_why_and_the_others_go_on(monkeypatch):
    def out_of_memory(method, *_):
        if method == "mimic":
            raise MemoryError("no room")
        return {"median_ms": 1.0}

    monkeypatch.setattr(kernel, "run", out_of_memory)
    arms = kernel.planar_pair(3)
    cases = {1: (arms, 1), 2: (arms, 2)}
    measured = [row for name in ("mimic", "matrices") for row in kernel.sweep("batch", cases, name)]
    failed = [row for row in measured if "failed" in row]
    assert [row["failed"] for row in failed] == ["MemoryError: no room"] * 3  # one size of each quantity
    assert sum(row["method"] == "matrices" for row in measured) == 4
