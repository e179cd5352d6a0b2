"""The examples run from the command line, and their output is correct."""

import ast
import json
import os
import re
import runpy
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import mimic
from tests.helpers.repository import CACHED, REPOSITORY

EXAMPLES = REPOSITORY / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("[0-9]*.py"))
patience = pytest.mark.timeout(900)


@pytest.fixture
def said(request, tmp_path):
    """The output of the test's example, which writes into the test's folder."""
    name = request.param
    result = subprocess.run(
        [sys.executable, str(EXAMPLES / f"{name}.py"), str(tmp_path)],
        capture_output=True, text=True, check=False, cwd=tmp_path, env={**os.environ, **CACHED},
    )  # fmt: skip
    assert result.returncode == 0, result.stdout[-1000:] + result.stderr[-2000:]
    return result.stdout


def example(name, *marks):
    """Parametrises a test with the output of an example."""
    return pytest.mark.parametrize("said", [pytest.param(name, marks=marks)], indirect=True, ids=[name])


def number(pattern, text):
    """The one number that a pattern captures."""
    (found,) = re.findall(pattern, text)
    return float(found)


def is_picture(path):
    """Whether a picture shows something: more than ten colours are frequent."""
    with Image.open(path) as image:
        colours = image.convert("RGB").getcolors(2**24) or []
    return len([count for count, _ in colours if count > 20]) > 10


def test_the_index_lists_all_nine_examples():
    index = (EXAMPLES / "README.md").read_text()
    assert [name[:2] for name in NAMES] == [f"{n:02}" for n in range(1, 10)]
    for name in NAMES:
        assert f"]({name}.py)" in index


@pytest.mark.parametrize("name", NAMES)
def test_examples_use_what_is_public(name):
    tree = ast.parse((EXAMPLES / f"{name}.py").read_text())
    modules = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    modules += [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    own = {module for module in modules if module.split(".")[0] == "mimic"}
    assert "mimic" in own and own <= {"mimic", "mimic.gymnasium"}
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "mimic"
    }
    assert used and used <= {*mimic.__all__, "gymnasium"}
    assert all(hasattr(mimic, attribute) for attribute in used - {"gymnasium"})


@pytest.mark.slow
def test_metric(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["01_metric.py", str(tmp_path)])
    runpy.run_path(str(EXAMPLES / "01_metric.py"), run_name="__main__")
    said = capsys.readouterr().out
    pattern = r"holding the start pose: (\S+)   copied angles: (\S+)   kinematic bound: (\S+)"
    ((rest, copied, bound),) = re.findall(pattern, said)
    assert 0 < float(bound) < float(copied) < float(rest)
    gap = (float(copied) - float(bound)) / (float(rest) - float(bound))
    said_gap = number(r"1 for holding the start pose: (\S+)%", said) / 100
    assert said_gap == pytest.approx(gap, abs=0.006)  # of four digits
    contributions = [float(value) for value in re.findall(r"^  link\S+ +(\S+)  \(", said, re.MULTILINE)]
    assert len(contributions) == 7 and sum(contributions) == pytest.approx(float(copied), abs=3e-4)
    parts = ("translation", "rotation", "linear_velocity", "angular_velocity")
    by_part = {part: number(rf"\n  {part} +(\S+)(?=\n)", said) for part in parts}
    weighted = sum(getattr(mimic.PAPER_WEIGHTS, part) * value for part, value in by_part.items())
    assert weighted == pytest.approx(float(copied), abs=2e-4)
    assert is_picture(tmp_path / "links.png")


@pytest.mark.slow_for("02_batches_and_gradients")
@example("02_batches_and_gradients")
def test_batches_and_gradients(said):
    rows = re.findall(r"(?:gradient \[1/rad\]|central differences): +\[(.*)\]", said)
    gradient, differences = (np.array(row.split(), float) for row in rows)
    np.testing.assert_allclose(gradient, differences, atol=2e-3)  # float32 over 0.02 rad, and four digits
    assert np.abs(gradient).max() > 0.01
    ((distance, gradient),) = re.findall(r"same motion: distance (\S+), gradient (\S+)", said)
    assert float(distance) < 1e-9 and float(gradient) < 1e-2  # rounding, of a distance whose terms have a kink there
    assert number(r"a loop over them differ by (\S+)", said) < 1e-5
    rates = re.findall(r" s +\S+ ms +([\d,]+)$", said, re.MULTILINE)
    assert len(rates) == 4 and all(int(rate.replace(",", "")) > 0 for rate in rates)
    ((before, after),) = re.findall(r"mean distance (\S+) before, (\S+) after", said)
    assert float(after) < 0.7 * float(before)


@example("03_imitate_poses", patience, pytest.mark.slow)
def test_imitate_poses(said, tmp_path):
    methods = ("imitate_pose", "gradient descent, one guess", "copied angles", "random")
    errors = [number(rf"\n{method} +\S+ +(\S+)%", said) for method in methods]
    assert errors == sorted(errors) and errors[0] < 1 and errors[-1] == 100
    assert is_picture(tmp_path / "poses.png")


@example("04_pose_mapper", patience, pytest.mark.slow)
def test_pose_mapper(said, tmp_path):
    assert number(r"for a random pose: (\S+)%", said) < 20
    optimiser, mapper = (
        number(rf"\n{name} +(\d+) poses a second", said.replace(",", "")) for name in ("optimiser", "mapper")
    )
    assert mapper > optimiser
    names = "optimiser", "mapper", "zero pose"
    distances, steps = (
        [number(rf"\n{name} +.*{what} (\S+)", said) for name in names] for what in ("distance", "step of a joint")
    )
    assert distances == sorted(distances) and steps[2] == 0 < steps[0] < steps[1]
    motions = mimic.load_demonstrations(tmp_path / "optimised" / "expert.npz")
    assert motions.joint_names == ("joint1", "joint2", "joint4", "joint5") and motions.count == 4
    assert is_picture(tmp_path / "retargeted.png")


@example("05_demonstrations", pytest.mark.slow)
def test_demonstrations(said, tmp_path):
    for line in re.findall(r"  maximum .*: +(.*)", said):
        assert all(0 < float(percent) <= 100 for percent in line.replace("%", "").split())
    assert mimic.load_demonstrations(tmp_path / "recorded.npz").count == 20
    waves = mimic.load_demonstrations(tmp_path / "waves.npz")
    times = 0.1 * np.arange(51)
    for number_of_wave, tempo in enumerate((1.0, 0.5)):
        expected = 0.6 * np.sin(1.5 * tempo * times) ** 2
        np.testing.assert_allclose(waves.qpos[number_of_wave, :, 0], expected, atol=1e-3)  # splines of 0.02 s
    assert "velocities: computed from the angles" in said
    assert re.search(r"degrees.csv is rejected: .* expected rad in", said)
    assert re.search(r"clock.csv is rejected: .* its velocity limit is", said)
    assert 0 < number(r"mean kinematic bound over the first wave: (\S+)", said) < 0.5
    assert is_picture(tmp_path / "waves_and_bound.png") and is_picture(tmp_path / "waves.png")


@example("06_train_and_evaluate", patience, pytest.mark.slow)
def test_train_and_evaluate(said, tmp_path):
    gap = json.loads((tmp_path / "run" / "report.json").read_text())["optimality_gap"]
    assert gap["train"] < 0.3  # it learns: the start is at 1.8
    pattern = r"held-out gap: (\S+)% after training, (\S+)% from the checkpoint, (\S+)% of PD control"
    ((trained, again, controlled),) = re.findall(pattern, said)
    assert trained == again != controlled
    assert float(trained) / 100 == pytest.approx(gap["held_out"], abs=1e-4)
    assert (tmp_path / "policy.mp4").stat().st_size > 10_000


@example("07_own_arm", patience, pytest.mark.slow)
def test_own_arm(said, tmp_path):
    assert mimic.load_mjcf(tmp_path / "arm.xml").joint_names == ("turn", "shoulder", "elbow", "bend", "roll")
    inspection = json.loads((tmp_path / "inspected" / "inspection.json").read_text())
    assert inspection["bound"] < inspection["hold"] and f"for a full training: {inspection['train']}" in said
    assert is_picture(tmp_path / "inspected" / "arms.png")
    assert "exit code: 2" in said
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["env"] == "pair" and report["optimality_gap"]["train"] < 1  # 1: holding the start pose; at first 2


@example("08_other_tools", patience, pytest.mark.slow)
def test_other_tools(said, tmp_path):
    pytest.importorskip("onnxruntime")
    rewards = {name: number(rf"\n  {name} +(\S+)", said) for name in ("no torque", "the policy, by ONNX Runtime")}
    assert rewards["no torque"] < rewards["the policy, by ONNX Runtime"] < 0
    ((here, reported),) = re.findall(r"demonstrations: (\S+) by Gymnasium and ONNX Runtime, (\S+) in the report", said)
    assert float(here) == pytest.approx(float(reported), rel=1e-3)  # 50 steps in float32, rounded in another order
    assert (tmp_path / "policy.onnx").stat().st_size > 1000


@pytest.mark.slow_for("09_swarm")
@example("09_swarm")
def test_swarm(said, tmp_path):
    assert number(r"order of its numbers: (\S+)", said) > number(r"shortest flights: +(\S+)", said)
    ((before, after),) = re.findall(r"distance at the start: (\S+);.* mean of the last 5 s: (\S+)", said)
    assert float(after) < 0.05 * float(before)
    ((far, near),) = re.findall(r"(\S+) at the start, (\S+) in the last 5 s", said)
    assert float(near) < 0.03 < 0.3 < float(far)  # chain lengths; the bodies of a straight arm are 0.07 apart
    assert number(r"fastest body .*: (\S+), in", said) <= 0.5
    assert is_picture(tmp_path / "swarm.png")
