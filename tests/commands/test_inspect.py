"""`python -m mimic.inspect`, and the other commands with a learner from a file."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import mimic
from mimic import inspect
from mimic.commands import arm_checks, cli
from mimic.envs.config import EnvConfig
from tests.helpers import original_model

FEW = ["env.demonstrations.count=4", "env.demonstrations.held_out=2"]


@pytest.fixture
def arm_file(tmp_path):
    file = tmp_path / "arm.xml"
    file.write_text(original_model.ur_like(actuators="position"))
    return file


@pytest.fixture
def inspected(monkeypatch, capsys):
    """A function that runs the command on an arm and returns its output."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["mimic.inspect", *map(str, arguments)])
        cli.run(inspect.prepare, "inspect")
        return capsys.readouterr().out

    return run


def test_an_inspection_describes_the_arm(inspected, arm_file, tmp_path):
    said = inspected(arm_file, "bound=false", f"out={tmp_path / 'out'}")
    for text in (
        "ur_like: 6 joints, 7 links",
        "expert panda: 7 joints",
        "6 actuators (6 servos on position)",
        "distal to the tip, fixed; their bodies stay as mass: left (slide), right (slide)",
        "1 equality constraints",
        "no velocity limit for pan, lift",
        "no <inertial> in pan_link",
    ):
        assert text in said, said
    inspection = json.loads((tmp_path / "out" / "inspection.json").read_text())
    assert [joint["torque limit"] for joint in inspection["joints"]] == [150] * 6
    fractions = np.array([sum(link["compared with"].values()) for link in inspection["links"]])
    np.testing.assert_allclose(fractions, 1, rtol=1e-6)  # float32
    assert Image.open(tmp_path / "out" / "arms.png").size == (1300, 560)
    assert said.splitlines()[-1] == f"train it: {inspection['train']}"


def test_armature_is_suggested_for_an_arm_that_runs_away(inspected, tmp_path):
    file = tmp_path / "light.xml"
    file.write_text(original_model.ur_like(armature=0.0))
    said = inspected(file, "bound=false")
    assert "warning: random torques accelerate a joint to" in said
    (armature,) = re.findall(r"train it: .* 'env.learner.armature={(\S+)}' 'env.learner.damping=\S+", said)
    proposed = {name: float(value) for name, value in (entry.split(":") for entry in armature.split(","))}
    assert "wrist_3" in proposed and len(set(proposed.values())) > 1  # by joint


def test_joints_that_are_slow_enough_stay_as_they_are(tmp_path):
    """A joint gets rotor inertia only if it exceeds the bound itself, and then no joint does."""
    file = tmp_path / "light.xml"
    file.write_text(original_model.ur_like(armature=0.0))
    env, config = EnvConfig(), mimic.ArmConfig(model=str(file), armature={"pan": 0.05})
    arm = mimic.build_arm(config)
    changed, reason = arm_checks.stabilised(config, arm, env)
    speeds = arm_checks.random_torque_speeds(mimic.build_arm(changed), env)
    assert reason and speeds.max() < env.speed_bound and changed.armature["pan"] >= 0.05
    assert set(changed.armature) < set(arm.embodiment.joint_names)
    assert arm_checks.stabilised(changed, mimic.build_arm(changed), env) == (changed, "")


@pytest.mark.slow
def test_an_equal_arm_reaches_the_poses_of_the_expert(inspected):
    said = inspected("panda")
    line = r"(\S+) for the best poses, (\S+) for holding the start pose; imitation can reduce it by (\d+)%"
    ((bound, hold, percent),) = re.findall(line, said)
    assert float(bound) < 0.01 < 0.1 < float(hold) and int(percent) > 95


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.xml"], "no MJCF or URDF file at '"),
        (["arm.xml", "learner.locked=[shoulder]"], "unknown joint 'shoulder'; valid are pan, lift, elbow, wrist_1"),
        (["arm.xml", "learner.tip=hand"], "the model has no body 'hand'; valid are table, pan_link"),
        (["arm.xml", "learner.base=foot"], "the model has no body 'foot'; valid are table, pan_link"),
        (["arm.xml", "expert=missing.urdf"], "no MJCF or URDF file at '"),
        (
            ["arm.xml", "learner.armature=-1"],
            "armature: expected a number from 0 to 10000, or a mapping from names to such numbers, got -1",
        ),
        (["arm.xml", "limits=soft"], "limits: expected one of none, hardware, got 'soft'"),
        (["arm.xml", "out=missing/out"], "there is no folder 'missing'"),
    ],
)
def test_bad_input_of_an_inspection(reason, arm_file, arguments, message):
    assert message in reason("inspect", *(str(arm_file) if word == "arm.xml" else word for word in arguments))


def test_an_unknown_key_of_the_command(rejected, arm_file):
    assert "unknown key 'tip'" in rejected("inspect", arm_file, "tip=hand")


@pytest.mark.parametrize("role", ["expert", "learner"])
def test_bad_arms_of_a_pair(rejected, arm_file, role):
    assert "no MJCF or URDF file" in rejected("train", "env=pair", f"env.{role}=missing.xml")


def test_a_pair_takes_arms_by_file(arm_file):
    env = mimic.make("pair", learner=str(arm_file), demonstrations={"count": 2, "held_out": 1})
    assert env.action_size == 6 and env.learner.name == "ur_like" and env.expert.name == "panda"
    swapped = mimic.make("pair", expert=str(arm_file), demonstrations={"count": 2, "held_out": 1})
    assert swapped.action_size == 7 and swapped.demonstrations.arm == "ur_like"


@pytest.mark.slow
@pytest.mark.timeout(1200)  # three commands that compile, on two cores
def test_a_learner_from_a_file_is_trained_evaluated_and_rendered(arm_file, tmp_path):
    run_dir = tmp_path / "run"

    elsewhere = tmp_path / "elsewhere"  # a run finds its arms from any folder
    elsewhere.mkdir()

    def command(name, *arguments, folder=elsewhere):
        result = subprocess.run(
            [sys.executable, "-m", f"mimic.{name}", *map(str, arguments)],
            capture_output=True, text=True, check=False, cwd=folder,
        )  # fmt: skip
        assert result.returncode == 0, result.stderr[-2000:]

    sizes = ["num_envs=64", "batch_size=32", "num_minibatches=4", "num_updates_per_batch=1", "num_timesteps=5000"]
    small = [f"trainer.{size}" for size in (*sizes, "hidden_layers=[16]", "evaluations=1", "preset=cpu")]
    pair = ["env=pair", "env.learner=arm.xml", *FEW]
    command("train", *pair, *small, f"run_dir={run_dir}", folder=tmp_path)
    report = json.loads((run_dir / "report.json").read_text())
    assert report["env_steps"] >= 5000 and np.isfinite(report["optimality_gap"]["held_out"])
    command("evaluate", f"run={run_dir}", f"out={tmp_path / 'again'}")
    command("render", f"run={run_dir}")
    assert (run_dir / "videos" / "held_out-0.mp4").stat().st_size > 10_000
