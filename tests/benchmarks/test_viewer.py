"""`python -m benchmarks.viewer`, with few clients and for some seconds."""

import importlib.util
import json
import subprocess
import sys

import pytest


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="needs viser: pip install 'mimic-arms[view]'")
def test_twenty_clients_move_the_arms(tmp_path):
    command = [sys.executable, "-m", "benchmarks.viewer", "--seconds", "10", "--rate", "2"]
    result = subprocess.run(
        [*command, "--out", str(tmp_path / "viewer.json")], capture_output=True, text=True, check=False, timeout=280
    )
    assert result.returncode == 0, result.stderr[-2000:]
    measured = json.loads((tmp_path / "viewer.json").read_text())
    assert measured["clients"] == 20 and measured["fewest_frames"] > 0
    assert measured["errors"] == [] and measured["exit_code"] == 0
