"""`python -m benchmarks.profile`: what it makes of a device's events."""

import pytest

from benchmarks import profile
from benchmarks.profile import Event

EVENTS = [
    Event("fusion_12", 0, 4e6),
    Event("sm90_xmma_gemm_f32f32", 3e6, 2e6),
    Event("MemcpyD2H", 10e6, 1e6),
    Event("fusion_12", 20e6, 1e6),
    Event("void cublasLt::splitKreduce_kernel<32, 16, int>", 30e6, 1e6),
    Event("kernel", 40e6, 1e6),
]


def test_events_are_added_up_by_what_they_are():
    rows = {row["what"]: (row["count"], row["ms"]) for row in profile.by_name(EVENTS, profile.kind)}
    assert rows == {
        "other fusions": (2, 5.0),
        "matrix products": (2, 3.0),
        "copy, device to host": (1, 1.0),
        "physics": (1, 1.0),
    }


def test_time_in_which_two_kernels_run_counts_once():
    assert profile.busy(EVENTS) == pytest.approx(9e-3)


def test_without_a_gpu_it_says_so(monkeypatch):
    monkeypatch.setattr("sys.argv", ["profile", "--env", "planar4dof", "--batches", "1"])
    with pytest.raises(SystemExit, match="expected a GPU"):
        profile.main()
