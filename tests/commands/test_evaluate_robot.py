"""`python -m mimic.evaluate robot=`: policies on virtual robots, their gap, and what is counted."""

import dataclasses
import functools
import json
import shutil
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.commands.config import EvaluateConfig
from mimic.commands.evaluate import _check_commands, prepare_evaluation
from mimic.commands.evaluate_robot import prepare_robot_evaluation, summary
from mimic.control.joint_control import Reference
from mimic.deploy.bundle import load_bundle
from mimic.deploy.fake_robot import FakeRobot
from mimic.deploy.policy import Policy
from mimic.deploy.runner import run_controller
from mimic.deploy.safety import INTERVENTIONS
from mimic.envs.world_env import SENT_ACTIONS, control_observation
from mimic.evaluation.virtual_robot.episodes import Episodes
from mimic.runs.checkpoints import load_checkpoint, save_checkpoint
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.export.config import ExportConfig
from mimic.trainers.export.export import prepare_export
from mimic.trainers.export.export_controller import expert_table, prepare_controller
from mimic.trainers.make import make_ppo_trainer
from mimic.trainers.ppo.ppo import make_controller
from mimic.trainers.run_config import load_config, save_config
from tests.helpers.run_directories import write_run
from tests.helpers.untrained_run import untrained_run

pytest.importorskip("onnxruntime")
HORIZON, HELD_OUT = 10, 3


def run_of_a_panda(folder, **settings):
    few = {"count": 2, "held_out": HELD_OUT}
    env = mimic.env_config("panda7dof", limits="hardware", horizon=HORIZON, demonstrations=few, **settings)
    return untrained_run(folder, env)


@pytest.fixture(scope="module")
def hardware_run(tmp_path_factory):
    """A run in the hardware world with random weights and statistics, its trainer, and its exported controller."""
    folder = tmp_path_factory.mktemp("runs")
    run_dir = run_of_a_panda(folder / "run", world="hardware")
    trainer = make_ppo_trainer(load_config(run_dir), run_dir)
    statistics, *networks = load_checkpoint(run_dir, trainer.params_template())[1]
    rng, size = np.random.default_rng(0), trainer.evaluator.env.observation_size
    statistics = statistics.replace(
        mean=jnp.asarray(rng.normal(size=size), jnp.float32), std=jnp.asarray(rng.uniform(0.3, 2, size), jnp.float32)
    )
    save_checkpoint(run_dir, 1, (statistics, *networks))
    prepare_export(ExportConfig(str(run_dir), str(folder / "controller"), "controller"))()
    return run_dir, trainer, folder / "controller"


@pytest.fixture
def evaluation(hardware_run, monkeypatch):
    """A function that evaluates the run, whose controller was exported before."""
    run_dir, trainer, controller = hardware_run
    copy = lambda run_dir, steps: lambda folder: shutil.copytree(controller, folder)  # noqa: E731
    monkeypatch.setattr("mimic.trainers.export.export_controller.prepare_controller", copy)

    def run(out, **settings):
        settings = {"robot": "virtual_panda", "episodes": 4, **settings}
        config = EvaluateConfig(str(run_dir), out=str(out), compilation_cache="", **settings)
        prepare_robot_evaluation(config, load_config(run_dir), trainer, run_dir)()
        return json.loads((out / "report.json").read_text())

    return run


def evaluate(run_dir, out, **settings):
    settings = {"robot": "virtual_panda", "episodes": 4, **settings}
    config = EvaluateConfig(str(run_dir), out=str(out), compilation_cache="", **settings)
    prepare_evaluation(config, 0.0)()
    return json.loads((out / "report.json").read_text())


def test_a_policy_of_the_hardware_world(evaluation, tmp_path, capsys):
    report = evaluation(tmp_path / "new", robot_loop="ruckig")
    assert report["robot_loop"] == "ruckig"
    row = report["cases"]["all ranges"]
    assert report["robot"] == "virtual_panda" and report["world"]["payload"] == [0.0, 3.0]
    assert row["episodes"] == row["completed"] == 4 and row["aborts"] == row["stops"] == {}
    assert row["limit_violations"] == row["self_contacts"] == 0 and row["clearance"] > 0.01
    assert row["lower_bound"] < row["mean_distance"] and np.isfinite(row["optimality_gap"])
    printed = capsys.readouterr().out
    assert "4 episodes on virtual_panda" in printed and "aborts of the robot" in printed


@pytest.mark.slow
def test_the_edges_of_the_world(evaluation, tmp_path):
    report = evaluation(tmp_path / "new", episodes=1, edges=True)
    assert {"all ranges", "payload=0", "payload=3", "all: corners", "action_delay=3"} <= report["cases"].keys()
    assert all(row["episodes"] == 1 and not row["aborts"] for row in report["cases"].values())


def test_the_gap_is_that_of_the_evaluator(hardware_run):
    """An arm that stays in its start pose has a gap of one, and one in the nearest poses that of the evaluator."""
    evaluator = hardware_run[1].evaluator
    motion = np.arange(2, 2 + HELD_OUT)
    held = np.repeat(np.asarray(evaluator.env.start_poses)[motion][:, None], HORIZON, axis=1)
    zero, none = np.zeros(HELD_OUT), np.full(HELD_OUT, "", object)
    counts = {name: zero.astype(int) for name in INTERVENTIONS}
    episodes = Episodes(motion, held, 0 * held, 0 * held, none, none, counts, zero, zero)
    assert summary(evaluator, episodes)["optimality_gap"] == pytest.approx(1, abs=1e-5)
    expert = evaluator.env.demonstrations
    copied = dataclasses.replace(
        episodes, qpos=expert.qpos[motion, 1 : HORIZON + 1], qvel=expert.qvel[motion, 1 : HORIZON + 1]
    )
    assert summary(evaluator, copied)["optimality_gap"] == pytest.approx(0, abs=1e-5)  # the expert has the same joints


def test_a_controller_is_exported(hardware_run):
    bundle = load_bundle(hardware_run[2])
    assert bundle.mode == "joint_velocity" and bundle.ticks == HORIZON and bundle.joint_names[6] == "joint7"
    robot = FakeRobot(bundle.start_poses[0], bundle.limits)
    assert run_controller(robot, bundle, clock=robot).is_complete


def test_an_exported_policy_is_the_policy(hardware_run):
    """On observations at random, at each tick and beyond the end of a motion."""
    run_dir, trainer, exported = hardware_run
    env, rng = trainer.evaluator.env, np.random.default_rng(0)  # its first motions are those of the training
    params = load_checkpoint(run_dir, trainer.params_template())[1]
    motions = [1, 0, 1]
    policy = Policy(load_bundle(exported), motions)
    controller = make_controller(trainer.settings, env.observation_size, env.action_size)(params)
    observe = jax.vmap(functools.partial(control_observation, env))
    act = jax.jit(lambda *parts: controller(SimpleNamespace(obs=observe(*parts))))
    past, table = np.zeros((3, SENT_ACTIONS * env.action_size), np.float32), expert_table(env)
    for tick in range(HORIZON + 2):
        measured = rng.uniform(-1, 1, (4, 3, env.learner.num_joints)).astype(np.float32)
        steps = np.minimum(np.arange(tick, tick + env.config.preview + 1), HORIZON)
        expert = table[motions][:, steps].reshape(3, -1)
        expected = np.asarray(act(np.concatenate(measured, axis=1), past, expert))
        qpos, qvel, *reference = measured
        observed = tick, qpos, qvel, Reference(reference[0], reference[1], reference[1])
        action = policy.act(*observed)
        assert np.ptp(expected) > 0.1
        np.testing.assert_allclose(action, expected, atol=1e-5)  # float32, sums in another order
        past = np.concatenate([expected, past[:, : -env.action_size]], axis=1)


@pytest.mark.parametrize("env", ["panda7dof", "planar4dof"])
def test_a_run_without_an_inner_loop_has_no_controller_and_no_robot(tmp_path, env):
    trained = TrainConfig(mimic.env_config(env), PPOConfig())
    save_config(tmp_path, trained)
    with pytest.raises(ValueError, match="format=controller: expected a run of trainer=ppo with an inner loop"):
        prepare_controller(tmp_path)
    with pytest.raises(ValueError, match="robot: expected a run with an inner loop, as of world=hardware, got one"):
        prepare_robot_evaluation(EvaluateConfig(robot="virtual_panda"), trained, None, tmp_path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"world": "nominal", "control": "torque"}, "got torque"),
        ({"world": "nominal", "control_dt": 0.02}, "got 0.02 s"),  # as long as the latency
    ],
)
def test_what_the_safety_layer_cannot_run_is_rejected(tmp_path, settings, message):
    trained = TrainConfig(mimic.env_config("panda7dof", **settings), PPOConfig())
    save_config(tmp_path, trained)
    with pytest.raises(ValueError, match=message):
        prepare_controller(tmp_path)
    with pytest.raises(ValueError, match=message):
        prepare_robot_evaluation(EvaluateConfig(robot="virtual_panda"), trained, None, tmp_path)


@pytest.mark.parametrize(
    ("settings", "controller", "message"),
    [
        (
            {"world": "nominal"},
            "pd",
            "policy, hold or tracking for a run with an inner loop and control=joint_velocity",
        ),
        ({"world": "nominal", "control": "torque"}, "tracking", "policy or hold for a run with an inner loop and"),
        ({}, "tracking", "policy, .*nearest_pose or mpc for a run with no inner loop"),
    ],
)
def test_controllers_whose_commands_the_run_does_not_have(settings, controller, message):
    with pytest.raises(ValueError, match=f"controller: expected {message}.*, got {controller}"):
        _check_commands(mimic.env_config("panda7dof", **settings), controller)


@pytest.mark.slow
def test_tracking_is_the_same_on_a_virtual_robot_as_in_the_environment(tmp_path):
    """Of nominal worlds, where nothing is random."""
    run = run_of_a_panda(tmp_path / "run", world="nominal", control="joint_position")
    row = evaluate(run, tmp_path / "virtual", controller="tracking")["cases"]["all ranges"]
    prepare_evaluation(
        EvaluateConfig(str(run), controller="tracking", out=str(tmp_path / "env"), compilation_cache=""), 0.0
    )()
    report = json.loads((tmp_path / "env" / "report.json").read_text())
    assert report["trainer"] == "tracking" and report["lead_ticks"] >= 1
    assert row["mean_distance"] == pytest.approx(report["mean_distance"]["held_out"], abs=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["robot=panda"], "robot: expected one of virtual_panda, virtual_robot, got 'panda'"),
        (["edges=true"], "edges: expected none without robot="),
        (["robot=virtual_panda", "robot_loop=mars"], "robot_loop: expected one of mimic, ruckig"),
        (["robot=virtual_panda", "robot_world=mars"], "robot_world: expected one of nominal, hardware"),
        (["robot=virtual_panda", "controller=pd"], "controller: expected policy or tracking with robot=, got pd"),
        (["robot=virtual_panda", "physics=mjx"], "expected none with robot="),
        (["robot=virtual_panda", "episodes=0"], "episodes: expected a whole number from 1"),
    ],
)
def test_what_does_not_fit_is_rejected(reason, hardware_run, arguments, message):
    assert message in reason("evaluate", f"run={hardware_run[0]}", "compilation_cache=", *arguments)


def test_a_mapper_has_no_robot(reason, tmp_path):
    run_dir = write_run(tmp_path / "run", [0.1], "panda4dof", trainer="pose_mapper")
    save_checkpoint(run_dir, 0, {"weight": np.zeros(1, np.float32)})
    error = reason("evaluate", f"run={run_dir}", "robot=virtual_panda", "compilation_cache=")
    assert "robot: expected a run of trainer=ppo with one learner" in error


def test_missing_packages_are_named(reason, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    error = reason("evaluate", "run=runs/NAME", "robot=virtual_panda")
    assert "robot: needs the package onnxruntime: pip install 'mimic-arms[deploy,export]'" in error
