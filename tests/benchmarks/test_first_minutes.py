"""`python -m benchmarks.first_minutes`: its commands are valid, and its arm is that of the page."""

import json
import sys
from pathlib import Path

import mujoco
import pytest

from benchmarks import first_minutes as benchmark
from tests.helpers.pages import check
from tests.helpers.repository import REPOSITORY


@pytest.mark.parametrize("stage", [*benchmark.STAGES[1:], benchmark.DEFAULT], ids=lambda stage: stage.name)
def test_commands_are_valid(stage, monkeypatch):
    program, name, *arguments = stage.command
    assert Path(program).name == "mimic"
    check(["python", "-m", f"mimic.{name}", *arguments], monkeypatch)
    assert (f"run_dir={stage.run_dir}" in arguments) == bool(stage.run_dir)


def test_the_arm_and_its_training_are_those_of_the_page():
    page = (REPOSITORY / "docs/own_arm.md").read_text()
    assert mujoco.MjModel.from_xml_string(benchmark.arm_of_page(page)).njnt == 6
    (policy,) = [stage for stage in benchmark.STAGES if stage.run_dir == "crane"]
    assert " ".join(policy.command[1:-2]) in page.replace(" \\\n   ", "").replace("python -m mimic.", "")


def test_the_default_is_that_of_the_readme():
    assert f"python -m mimic.{' '.join(benchmark.DEFAULT.command[1:-1])}" in (REPOSITORY / "README.md").read_text()


def test_results(monkeypatch, tmp_path):
    """Stages in their order, with what is installed, and no path of this machine."""
    monkeypatch.setattr(benchmark, "build_wheel", lambda folder: "mimic.whl")
    monkeypatch.setattr(benchmark, "run_process", lambda command, cwd: None)
    monkeypatch.setattr(benchmark, "installed_versions", lambda folder: {"python": "3.11"})
    monkeypatch.setattr(
        benchmark, "run_stage", lambda stage, *_: {"stage": stage.name, "command": " ".join(stage.command)}
    )
    out = tmp_path / "out.json"
    monkeypatch.setattr(sys, "argv", ["first_minutes", "--out", str(out), "--default", "--commit", "none"])
    benchmark.main()
    results = json.loads(out.read_text())
    stages = ["install", *(stage.name for stage in benchmark.STAGES), benchmark.DEFAULT.name]
    assert [row["stage"] for row in results["stages"]] == stages
    assert results["installed"] == {"python": "3.11"} and sys.executable not in out.read_text()
