"""`python -m mimic.inspect`, and the other commands with a learner from a file."""

import json
import re

import numpy as np
import pytest
from PIL import Image

import mimic
from mimic.commands import arm_checks
from mimic.commands import inspect as inspection_command
from mimic.envs.config import EnvConfig
from tests.helpers import original_model
from tests.helpers.commands import run


@pytest.fixture
def arm_file(tmp_path):
    file = original_model.ur_file(tmp_path, actuators="position")
    return file


def test_an_inspection_describes_the_arm(arm_file, tmp_path, monkeypatch):
    monkeypatch.setattr(inspection_command, "_SCENE", (200, 160))  # pixels: the full size takes seconds on a CPU
    said = run("inspect", arm_file, "bound=false", f"out={tmp_path / 'out'}")
    for text in (
        "ur_like: 6 joints, 7 links",
        "expert panda: 7 joints",
        "ends at: site 'pinch', named as tools are",
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


def test_armature_is_suggested_for_an_arm_that_runs_away(tmp_path):
    file = original_model.ur_file(tmp_path, armature=0.0)
    said = run("inspect", file, "bound=false")
    assert "warning: random torques accelerate a joint to" in said
    (armature,) = re.findall(r"train it: .* 'env.learner.armature={(\S+)}' 'env.learner.damping=\S+", said)
    proposed = {name: float(value) for name, value in (entry.split(":") for entry in armature.split(","))}
    assert "wrist_3" in proposed and len(set(proposed.values())) > 1  # by joint


@pytest.mark.parametrize(("mass", "is_weak"), [(2.0, False), (2000.0, True)])
def test_an_arm_that_is_too_heavy_for_its_torques_is_noted(tmp_path, mass, is_weak):
    """As of a file whose masses are in g."""
    geom = f'<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="{mass}"/>'
    link = f'<body pos="0.3 0 0"><joint name="{{}}" axis="0 0 1"/>{geom}'
    motors = "".join(f'<motor joint="{name}" ctrlrange="-50 50" ctrllimited="true"/>' for name in "ab")
    world = f"<worldbody>{link.format('a')}{link.format('b')}</body></body></worldbody>"
    (file := tmp_path / "heavy.xml").write_text(f"<mujoco>{world}<actuator>{motors}</actuator></mujoco>")
    config = mimic.ArmConfig(model=str(file))
    said = [line for line in arm_checks.warnings(config, mimic.build_arm(config)) if "masses in kg" in line]
    assert bool(said) == is_weak and all(": at the torque limit it takes " in line for line in said)


def test_joints_that_are_slow_enough_stay_as_they_are(tmp_path):
    """A joint gets rotor inertia only if it exceeds the bound itself, and then no joint does."""
    file = original_model.ur_file(tmp_path, armature=0.0)
    env, config = EnvConfig(), mimic.ArmConfig(model=str(file), armature={"pan": 0.05})
    arm = mimic.build_arm(config)
    changed, reason = arm_checks.stabilised(config, arm, env)
    speeds = arm_checks.random_torque_speeds(mimic.build_arm(changed), env)
    assert reason and speeds.max() < env.speed_bound and changed.armature["pan"] >= 0.05
    assert set(changed.armature) < set(arm.embodiment.joint_names)
    assert arm_checks.stabilised(changed, mimic.build_arm(changed), env) == (changed, "")


def test_a_weak_arm_keeps_its_speed_with_the_suggested_damping(tmp_path):
    """Servos of 0.01 N m would creep at 0.1 rad/s against the damping of a large arm."""
    file = tmp_path / "small.xml"
    link = (
        '<body pos="0 0 0.02"><joint name="{0}" axis="{1}"/><geom type="capsule" fromto="0 0 0 0 0 0.02" size="0.003"/>'
    )
    links = "".join(link.format(f"j{i}", "0 1 0" if i % 2 else "0 0 1") for i in range(4))
    motors = "".join(f'<motor joint="j{i}" ctrlrange="-0.01 0.01" ctrllimited="true"/>' for i in range(4))
    velocity = '<custom><numeric name="velocity_limit" data="2 2 2 2"/></custom>'
    world = f"<worldbody>{links}{'</body>' * 4}</worldbody>"
    file.write_text(f'<mujoco model="small">{world}<actuator>{motors}</actuator>{velocity}</mujoco>')
    config = mimic.ArmConfig(model=str(file))
    changed, _ = arm_checks.stabilised(config, mimic.build_arm(config), EnvConfig())
    arm = mimic.build_arm(changed)
    assert np.all(arm.embodiment.torque_limit == 0.01) and arm.model.dof_damping.max() > 0
    assert np.all(arm.model.dof_damping * arm.embodiment.velocity_limit <= 0.5 * arm.embodiment.torque_limit + 1e-9)


@pytest.mark.slow
def test_an_equal_arm_reaches_the_poses_of_the_expert():
    said = run("inspect", "panda")
    line = r"(\S+) for the best poses, (\S+) for holding the start pose; imitation can reduce it by (\d+)%"
    ((bound, hold, percent),) = re.findall(line, said)
    assert float(bound) < 0.01 < 0.1 < float(hold) and int(percent) > 95


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["arm.xml", "arm.xml"], "expected one argument without a key, got "),
        (["missing.xml"], "no MJCF or URDF file at '"),
        (["."], ", which is a folder"),
        (
            ["arm.xml", "learner.locked=[shoulder]"],
            "learner.locked: unknown joint 'shoulder'; valid are pan, lift, elbow, wrist_1",
        ),
        (["arm.xml", "learner.tip=hand"], "learner.tip: expected a body or site of the model, table, pan_link"),
        (["arm.xml", "expert=ur99"], "expert.model: expected panda, planar, panda_pair, an MJCF or URDF file"),
        (["arm.xml", "expert=missing.urdf"], "expert: no MJCF or URDF file at '"),
    ],
)
def test_bad_input_of_an_inspection(reason, arm_file, arguments, message):
    assert message in reason("inspect", *(str(arm_file) if word == "arm.xml" else word for word in arguments))


def test_an_unknown_key_of_the_command(rejected, arm_file):
    assert "unknown key 'tip'" in rejected("inspect", arm_file, "tip=hand")


def test_a_pair_takes_arms_by_file(arm_file):
    env = mimic.make("pair", learner=str(arm_file), demonstrations={"count": 2, "held_out": 1})
    assert env.action_size == 6 and env.learner.name == "ur_like" and env.expert.name == "panda"
    swapped = mimic.make("pair", expert=str(arm_file), demonstrations={"count": 2, "held_out": 1})
    assert swapped.action_size == 7 and swapped.demonstrations.arm == "ur_like"
