"""The trained networks that come with mimic: they load, fit their environments, and reach their recorded metrics."""

import dataclasses
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import mimic
from mimic.commands.clips import prepare_clip
from mimic.commands.config import EvaluateConfig, RenderConfig
from mimic.commands.evaluate import prepare_evaluation
from mimic.evaluation.evaluator import Evaluator
from mimic.runs.checkpoints import load_checkpoint
from mimic.runs.files import REPORT
from mimic.runs.parameters import PARAMETERS, read_params
from mimic.trainers.pose_mapper.trainer import PoseMapperTrainer
from mimic.trainers.ppo import ppo
from mimic.trainers.pretrained import NETWORKS, pretrained_names
from mimic.trainers.pretrained.files import write_network
from mimic.trainers.pretrained.network import TRAINERS, policy_template, read_network
from mimic.trainers.run_config import policy_run

MAX_BYTES = 5_000_000  # of all of them: the package stays small
OBSERVATION = 246  # numbers that the policy of planar4dof observes
DEFAULT = ("panda3dof", "panda4dof", "panda7dof", "planar4dof", "planar7dof")
POLICIES, MAPPERS = (pretrained_names(kind) for kind in TRAINERS)
FOLDERS = [f"{name}-{kind}" for kind in TRAINERS for name in pretrained_names(kind)]


def quick(names):
    """Names as parameters; only those of planar arms compile quickly enough for `make test`."""
    return [pytest.param(name, marks=() if name.startswith("planar4") else pytest.mark.slow) for name in names]


def test_each_default_environment_has_both_and_they_are_small():
    assert MAPPERS == POLICIES == DEFAULT
    assert sum(path.stat().st_size for path in NETWORKS.rglob("*") if path.is_file()) <= MAX_BYTES


@pytest.mark.parametrize("folder", FOLDERS)
def test_each_says_where_it_comes_from(folder):
    network = mimic.load(*folder.rsplit("-", 1))  # type: ignore[arg-type]
    source = network.source
    assert len(source["commit"]) == 40 and source["command"].startswith(f"python -m mimic.train env={network.name} ")
    assert {"python", "jax", "numpy"} <= set(source["versions"]) and source["hardware"]["device"]
    assert source["env_steps" if network.kind == "policy" else "training_poses"] > 0
    best = network.report["lower_bound" if network.kind == "policy" else "optimal_distance"]["held_out"]
    # Between equal arms copying is the optimum, and what the optimiser stops at is above it by less than 1e-4.
    assert network.report["copying_distance"]["held_out"] >= best - 1e-4
    assert network.name in repr(network) and len(repr(network)) < 100


@pytest.mark.parametrize("name", quick(MAPPERS))
def test_a_mapper_reaches_its_recorded_distance(name):
    mapper = mimic.load(name, "pose_mapper")
    trainer = PoseMapperTrainer(mapper.config)
    poses = trainer.poses[-trainer.settings.held_out_poses :]
    distance = jax.jit(jax.vmap(mapper.function.distance))(poses, jax.jit(mapper)(poses))
    # Another machine or version rounds differently, and then a few poses get the second of two nearest candidates.
    assert float(distance.mean()) == pytest.approx(mapper.report["mean_distance"]["held_out"], rel=1e-3)
    report = mapper.report
    assert report["quality"]["held_out"] < 0.1 and distance.mean() < report["copying_distance"]["held_out"] + 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", POLICIES)
def test_a_policy_reaches_its_recorded_distance(name):
    policy = mimic.load(name)
    held_out = mimic.envs.imitation.training_and_held_out(policy.config.env)[1]
    evaluator = Evaluator(policy.env.with_demonstrations(held_out), held_out)
    rollouts = jax.jit(lambda: evaluator.rollout(lambda state: policy(state.obs)))()
    # A rollout adds up what another machine rounds differently, and the demonstrations are recorded anew.
    recorded = policy.report["mean_distance"]["held_out"]
    distance = np.asarray(rollouts.distance)[: held_out.count].mean()
    assert float(distance) == pytest.approx(recorded, rel=1e-3, abs=1e-5)
    assert recorded < 0.5 * policy.report["hold_distance"]["held_out"]
    # The distance hardly sees torques that are reversed at each step.
    change = np.diff(np.asarray(rollouts.torque)[: held_out.count], axis=1) / np.asarray(policy.env.torque_scale)
    assert np.sqrt((change**2).mean()) < 0.1


def test_a_batch_is_the_same_as_its_samples():
    networks = {7: mimic.load("planar4dof", "pose_mapper"), OBSERVATION: mimic.load("planar4dof")}
    for size, network in networks.items():
        inputs = np.random.default_rng(0).uniform(-3, 3, (5, size)).astype(np.float32)
        outputs = jax.jit(network)(inputs)
        assert outputs.shape == (5, 4)
        np.testing.assert_allclose(outputs[2], jax.jit(network)(inputs[2]), atol=1e-5)  # float32 matrix products
    assert np.abs(outputs).max() <= 1


def test_a_policy_reads_what_its_environment_observes():
    env = mimic.make("planar4dof", demonstrations={"count": 2, "held_out": 1})
    statistics, _ = policy_template(dataclasses.replace(mimic.load("planar4dof").config, env=env.config))
    assert statistics.mean.shape == (env.observation_size,) == (OBSERVATION,)


def test_commands_take_the_environment_of_a_policy_as_their_run(tmp_path, monkeypatch):
    """Its parameters are those of `mimic.load`; it has no value network, whose parameters are 0."""
    monkeypatch.chdir(tmp_path)
    run_dir, config = policy_run("planar4dof", None)
    template = ppo.params_template(config.trainer, OBSERVATION, 4, 3)  # type: ignore[arg-type]
    steps, params = load_checkpoint(run_dir, template)
    policy = mimic.load("planar4dof")
    assert steps == policy.source["env_steps"] and jax.tree.structure(params) == jax.tree.structure(template)
    assert not any(leaf.any() for leaf in jax.tree.leaves(params[2]))
    observations = np.random.default_rng(0).uniform(-1, 1, (3, OBSERVATION)).astype(np.float32)
    controller = ppo.make_controller(config.trainer, OBSERVATION, 4)(params)  # type: ignore[arg-type]
    actions = jax.jit(lambda obs: controller(SimpleNamespace(obs=obs)))(observations)  # type: ignore[arg-type]
    np.testing.assert_allclose(actions, jax.jit(policy)(observations), atol=1e-6)  # float32, compiled apart
    (tmp_path / "planar4dof").mkdir()  # the user's own folder comes first
    with pytest.raises(ValueError, match="which has a config.yaml, or one of panda3dof, .*, got 'planar4dof'"):
        policy_run("planar4dof", None)


def test_a_training_does_not_start_from_a_policy_without_a_value_network(reason):
    few = "env.demonstrations.count=1", "env.demonstrations.held_out=1"
    line = reason("train", "env=planar4dof", f"init={NETWORKS / 'planar4dof-policy'}", *few)
    assert line.startswith("init: expected a run directory with checkpoints, got ") and "a network alone" in line


@pytest.mark.slow
def test_a_policy_is_evaluated_and_shown_without_a_run_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = sorted(NETWORKS.rglob("*"))
    prepare_evaluation(EvaluateConfig("planar4dof", out="report"), 0.0)()
    report, recorded = json.loads((tmp_path / "report" / REPORT).read_text()), mimic.load("planar4dof").report
    # Another machine or version rounds differently, and the demonstrations are recorded anew.
    assert report["mean_distance"] == pytest.approx(recorded["mean_distance"], rel=1e-3)
    assert prepare_clip(RenderConfig("planar4dof")).out == Path("planar4dof-held_out-0.mp4")
    assert sorted(NETWORKS.rglob("*")) == before and [path.name for path in tmp_path.iterdir()] == ["report"]


def test_inputs_of_another_size_are_reported():
    policy = mimic.load("planar4dof")
    with pytest.raises(ValueError, match=r"observation: expected shape \[..., \d+\], got \[3\]"):
        policy(np.zeros(3))


def test_unknown_names_are_listed():
    with pytest.raises(ValueError, match="name: expected one of .*planar4dof.*, got 'panda5dof'"):
        mimic.load("panda5dof")
    with pytest.raises(ValueError, match="kind: expected one of policy, pose_mapper, got 'critic'"):
        mimic.load("panda4dof", "critic")  # type: ignore[arg-type]


@pytest.fixture
def copy(tmp_path):
    return shutil.copytree(NETWORKS / "planar4dof-pose_mapper", tmp_path / "network")


def test_damaged_folders_are_reported_in_one_line(copy):
    with pytest.raises(ValueError, match="expected a network of trainer=ppo, got pose_mapper"):
        read_network(copy, "policy")
    report = (copy / REPORT).read_text()
    (copy / REPORT).write_text("[]")
    with pytest.raises(ValueError, match=r"report.json' cannot be read: expected an object") as error:
        read_network(copy, "pose_mapper")
    assert "\n" not in str(error.value)
    (copy / REPORT).write_text(report)
    content = (copy / PARAMETERS).read_bytes()
    (copy / PARAMETERS).write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"parameters.npz' cannot be read"):
        read_network(copy, "pose_mapper")


def test_parameters_of_another_network_are_reported(copy):
    config = (copy / "config.yaml").read_text()
    (copy / "config.yaml").write_text(config.replace("- 128\n", "- 64\n", 1))
    with pytest.raises(ValueError, match=r"params/Dense_0/bias: expected shape \(64,\), got shape \(128,\)"):
        read_network(copy, "pose_mapper")
    (copy / "config.yaml").write_text(config.replace("inputs: link_states", "inputs: angles"))
    with pytest.raises(ValueError, match=r"params/Dense_0/kernel: expected shape \(7, 128\), got shape \(51, 128\)"):
        read_network(copy, "pose_mapper")


@pytest.mark.parametrize("half", [False, True])
def test_parameters_are_read_as_they_were_written(tmp_path, half):
    mapper = mimic.load("planar4dof", "pose_mapper")
    params = mapper.function.params
    config = dataclasses.replace(mapper.config, run_dir="runs/mine")
    write_network(tmp_path, config, params, {"env": "planar4dof", "source": {"gap": float("nan")}}, half=half)
    read = read_params(tmp_path, params)
    rounding = 2**-11 if half else 0  # of float16, relative
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=rounding, atol=rounding / 1000), read, params)
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(read))
    assert json.loads((tmp_path / REPORT).read_text())["source"] == {"gap": None}
    assert "runs/mine" not in (tmp_path / "config.yaml").read_text()
