"""What the commands refuse: one line that says what is valid, exit code 2, nothing written."""

import io
import os
import pickle
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.envs.recording import record_demonstrations

PLANAR = ["env=planar4dof", "env.demonstrations.count=1", "env.demonstrations.held_out=1"]
HINGE = '<joint name="{0}" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["env=panda5dof"], "unknown env 'panda5dof'; valid are pair, panda3dof, panda4dof, panda7dof"),
        (["trainer=sac"], "unknown trainer 'sac'; valid are "),
        (["env.previw=1"], "unknown key 'env.previw'; valid are"),
        (["seed=one"], "could not be converted to Integer"),
        (["env.learner.locked=[joint9]"], "unknown joint 'joint9'"),
        (["trainer.num_envs=500"], "must be a multiple of num_envs = 500"),
        (["trainer.learning_rate=inf"], "trainer.learning_rate: expected a number above 0, got inf"),
        (["env.demonstrations.path=missing.npz"], "no file"),
        (["resume=missing"], "not a run directory"),
        (["+foo=1"], "foo"),
        (["env.learner.locked=[3,joint3]"], "named twice"),
        (["env.learner.locked=[1,2,3,4,5,6,7]"], "all 7 joints are locked"),
        (["env.metric.correspondence=soft", "env.metric.xi=1"], "below 0"),
        (["env.metric.rotation=inf"], "finite weight"),
        (["env=planar4dof", "env.learner.link_lengths=[0.5,0]"], "above 0 [m]"),
        (["env.learner.model=missing.xml"], "missing.xml"),
        (["trainer=pose_mapper", "trainer.preset=huge"], "expected one of paper, large, got 'huge'"),
        (["trainer=pose_mapper", "trainer.batch_size=1000"], "expected a divisor of samples = 65536, got 1000"),
        (["trainer=pose_mapper", "trainer.heads=0"], "trainer.heads: expected at least 1, got 0"),
        (["trainer=pose_mapper", "trainer.inputs=pixels"], "expected one of angles, link_states"),
        (["trainer=pose_mapper", "trainer.num_envs=8"], "unknown key 'trainer.num_envs'; valid are name, preset"),
    ],
)
def test_bad_training_input(refused, arguments, message):
    assert message in refused("train", *arguments)


def test_bad_input_of_a_whole_process():
    result = subprocess.run(
        [sys.executable, "-m", "mimic.train", "env=panda5dof"], capture_output=True, text=True, timeout=60, check=False
    )
    assert result.returncode == 2 and result.stderr.count("\n") == 1 and "unknown env" in result.stderr


def test_a_graphics_library_that_is_missing_is_said_when_something_is_drawn(tmp_path):
    """PyOpenGL fails so where there is no libEGL."""
    (tmp_path / "OpenGL").mkdir()
    (tmp_path / "OpenGL" / "__init__.py").write_text("raise AttributeError('no eglQueryString')")
    code = "import mimic, mujoco.mjx; from mimic import ArmScene; ArmScene([mimic.ArmConfig()])"
    found = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}", "MUJOCO_GL": "egl"}
    ended = subprocess.run([sys.executable, "-c", code], env=found, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1].startswith("ValueError: rendering: no OpenGL library that works; expected EGL")


@pytest.fixture(scope="module")
def demonstrations():
    return record_demonstrations(build_arm(ArmConfig(model="planar", link_lengths=[1 / 7] * 7)), 2)


def contents(demonstrations, tmp_path):
    whole = tmp_path / "whole.npz"
    demonstrations.save(whole)
    with np.load(whole) as archive:
        return whole, dict(archive)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("truncated", "not a complete npz file"),
        ("text", "not a complete npz file"),
        ("pickled", "pickled objects"),
        ("bare pickle", "not a complete npz file"),
        ("not finite", "values that are not finite"),
        ("other arm", "panda"),
        ("other step", "0.2"),
    ],
)
def test_bad_demonstration_files(refused, demonstrations, tmp_path, change, message):
    whole, arrays = contents(demonstrations, tmp_path)
    path = tmp_path / "bad.npz"
    if change == "truncated":
        path.write_bytes(whole.read_bytes()[:-1000])
    elif change == "text":
        path.write_text("not an archive")
    elif change == "bare pickle":
        path.write_bytes(pickle.dumps(arrays))
    else:
        changes = {
            "pickled": {"goals": np.array([{}, []], object)},
            "not finite": {"qvel": np.full_like(arrays["qvel"], np.nan)},
            "other arm": {"arm": np.array("panda")},
            "other step": {"dt": np.array(0.2)},
        }[change]
        stream = io.BytesIO()
        np.savez(stream, **{**arrays, **changes})
        path.write_bytes(stream.getvalue())
    assert message in refused("train", *PLANAR, f"env.demonstrations.path={path}")


@pytest.mark.parametrize(
    ("bodies", "message"),
    [
        ('<body><geom size=".1"/></body>', "no hinge"),
        (
            f"<body>{HINGE.format('a')}<body>{HINGE.format('b')}</body><body>{HINGE.format('c')}</body></body>",
            "branch",
        ),
        ("<body", "XML"),
    ],
)
def test_bad_arms(refused, tmp_path, bodies, message):
    path = tmp_path / "arm.xml"
    path.write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    assert message in refused("train", "env=planar4dof", f"env.learner.model={path}")


def test_a_loop_is_refused(refused, tmp_path):
    spec = mujoco.MjSpec()
    parent = spec.worldbody
    for name in "abc":
        parent = parent.add_body(name=name, pos=[0.3, 0, 0], mass=1, inertia=[1, 1, 1], explicitinertial=True)
        parent.add_joint(name=name, axis=[0, 0, 1])
    loop = spec.add_equality(type=mujoco.mjtEq.mjEQ_CONNECT, name1="c", name2="world")
    loop.objtype = mujoco.mjtObj.mjOBJ_BODY
    spec.compile()
    path = tmp_path / "loop.xml"
    path.write_text(spec.to_xml())
    assert "loop" in refused("train", "env=planar4dof", f"env.learner.model={path}")


def test_bad_retargeting_input(refused, demonstrations, tmp_path):
    whole, _ = contents(demonstrations, tmp_path)
    arguments = [f"demonstrations={whole}", "learner=planar4dof", "out=new.npz", f"mapper={tmp_path}"]
    assert "not a run directory" in refused("retarget", *arguments)


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("figures", [], "out: expected a folder"),
        ("figures", ["out=new", "only=[contour]"], "expected some of"),
        ("render", [], "run: expected the run directory"),
        ("render", ["run=missing"], "not a run directory"),
        ("render", ["run=missing", "split=test"], "expected one of train, held_out, got 'test'"),
    ],
)
def test_bad_input_of_pictures(refused, command, arguments, message):
    assert message in refused(command, *arguments)


def test_bad_run_directories(refused, tmp_path):
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    assert "exists" in refused("train", f"run_dir={run_dir}")


@pytest.mark.parametrize(("command", "key"), [("train", "resume"), ("evaluate", "run"), ("render", "run")])
@pytest.mark.parametrize(
    ("config", "message"),
    [
        (None, "not a run directory"),
        ("trainer: {name: ppo}\n", "no checkpoint"),
        ("trainer: {name: sac}\n", "expected one of"),
        ("trainer: {name: ppo, previw: 1}\n", "previw"),
        ("a: [\n", "cannot be read"),
    ],
)
def test_unreadable_run_directories(refused, tmp_path, command, key, config, message):
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    if config is not None:
        (run_dir / "config.yaml").write_text(config)
    assert message in refused(command, f"{key}={run_dir}")


def test_all_commands_are_listed():
    commands = {f"mimic.{file.stem}" for file in (Path(mimic.__file__).parent / "conf").glob("*.yaml")}
    result = subprocess.run([sys.executable, "-m", "mimic"], capture_output=True, text=True, timeout=60, check=False)
    listed = [line.split(maxsplit=1) for line in result.stdout.splitlines()[2:]]
    assert result.returncode == 0 and {module for module, _ in listed} == commands


def test_help_names_the_environments():
    result = subprocess.run(
        [sys.executable, "-m", "mimic.train", "--help"], capture_output=True, text=True, timeout=60, check=False
    )
    assert result.returncode == 0 and "panda4dof" in result.stdout and "resume=DIR" in result.stdout
