"""`python -m mimic.export`: exported networks give the results of JAX and describe their inputs and outputs."""

import json
import shutil
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.metric.config import MetricConfig
from mimic.runs.checkpoints import save_checkpoint
from mimic.trainers.config import PoseMapperConfig, PPOConfig, TrainConfig
from mimic.trainers.export.config import ExportConfig
from mimic.trainers.export.export import exported_function
from mimic.trainers.export.export_controller import prepare_controller
from mimic.trainers.pose_mapper.mapper import PoseMapper
from mimic.trainers.pose_mapper.model import make_model
from mimic.trainers.ppo.ppo import initial_params, make_controller, make_networks
from mimic.trainers.run_config import load_config, save_config
from tests.helpers.metric_cases import random_poses
from tests.helpers.tiny import SHORT_ARMS
from tests.helpers.untrained_run import untrained_run

pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
TOLERANCE = 1e-5  # rad, or a fraction of the maximum torque: float32, sums in another order


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """The environment and the policy of a run with random weights and observation statistics, and its export."""
    env = mimic.make("panda4dof", demonstrations={"count": 1, "held_out": 1})
    run_dir = untrained_run(tmp_path_factory.mktemp("policy") / "run", env.config)
    config = load_config(run_dir).trainer
    networks = make_networks(config, env.observation_size, env.action_size, env.privileged_size)
    statistics, *networks = initial_params(networks, env.observation_size, jax.random.PRNGKey(0))
    rng = np.random.default_rng(0)
    statistics = statistics.replace(
        mean=jnp.asarray(rng.normal(size=env.observation_size), jnp.float32),
        std=jnp.asarray(rng.uniform(0.3, 2, env.observation_size), jnp.float32),
    )
    params = (statistics, *networks)
    save_checkpoint(run_dir, 7, params)
    controller = make_controller(config, env.observation_size, env.action_size)(params)
    return env, controller, session_of(mimic.export_run(run_dir, run_dir.parent / "policy.onnx"))


def mapper_run(run_dir, name="panda4dof", preset="paper", **settings):
    """A run whose mapper has random weights."""
    env = mimic.env_config(name, **settings)
    config = PoseMapperConfig(preset=preset, hidden_layers=[16, 16]).resolve()
    params = jax.jit(make_model(env, config).init)(jax.random.key(3))
    run_dir.mkdir()
    save_config(run_dir, TrainConfig(env, config))
    save_checkpoint(run_dir, 5, params)
    return PoseMapper.load(run_dir)


def session_of(path):
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


@pytest.mark.parametrize("batch", [1, 33])
def test_an_onnx_policy_equals_the_policy(policy, batch):
    env, controller, session = policy
    observations = np.random.default_rng(1).normal(size=(batch, env.observation_size)).astype(np.float32)
    action, torque = session.run(["action", "torque"], {"observation": observations})
    expected = jax.jit(lambda obs: controller(SimpleNamespace(obs=obs)))(observations)
    assert np.asarray(expected).std() > 0.1  # a check that can fail
    np.testing.assert_allclose(action, expected, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(torque, expected * env.torque_scale, rtol=0, atol=TOLERANCE * 87)  # N m, up to 87


def test_the_metadata_describes_inputs_and_outputs(policy):
    env, _, session = policy
    metadata = session.get_modelmeta().custom_metadata_map
    assert metadata["env"] == "panda4dof" and metadata["mimic_version"] == mimic.__version__
    assert json.loads(metadata["learner_joints"]) == ["joint1", "joint2", "joint4", "joint5"]
    np.testing.assert_allclose(json.loads(metadata["torque_scale"]), env.torque_scale)
    layout = {part["name"]: part for part in json.loads(metadata["observation_layout"])}
    state = jax.jit(env.reset)(jax.random.key(0))
    own = mimic.link_states(env.learner, state.pipeline_state.qpos)
    ahead = env.expert_at(state.pipeline_state.demonstration, jnp.array(1))
    for whose, states in {"learner": own, "expert 1 steps ahead": ahead}.items():
        parts = {name: values for name, values in vars(states).items() if name != "hand"}
        parts["hand x- and z-axes"] = states.hand.axes[jnp.array([0, 2])]
        for name, values in parts.items():
            part = layout[f"{whose}: {name}"]
            observed = state.obs[part["start"] : part["stop"]].reshape(part["shape"])
            np.testing.assert_allclose(observed, values, atol=1e-6)
    speeds = layout["learner: joint velocities"]
    assert (speeds["shape"], speeds["unit"]) == ([4], "rad/s")
    assert speeds["stop"] == max(part["stop"] for part in layout.values()) == env.observation_size


OTHER_METRIC = {"translation": 1.0, "correspondence": "soft", "rotation_measure": "angle", "reduction": "frobenius"}


@pytest.mark.slow_for("planar4dof-large-metric1", "panda3dof-large-metric2", "short-large-metric3")
@pytest.mark.parametrize(
    ("name", "preset", "metric"),
    [
        ("panda4dof", "paper", MetricConfig()),
        ("planar4dof", "large", MetricConfig(adaptive=True)),
        ("panda3dof", "large", MetricConfig(**OTHER_METRIC)),
        ("short", "large", MetricConfig()),
    ],
)
def test_an_onnx_pose_mapper_equals_the_mapper(tmp_path, name, preset, metric):
    arms = {} if name != "short" else SHORT_ARMS
    mapper = mapper_run(tmp_path / "run", "planar4dof" if arms else name, preset, metric=metric, **arms)
    session = session_of(mimic.export_run(tmp_path / "run", tmp_path / "mapper.onnx"))
    poses = random_poses(mapper.expert, 200)
    (outputs,) = session.run(None, {"expert_qpos": poses})
    expected = mapper(poses)
    # Where two heads are equally good, rounding decides; where a point is near the seam of the circle, it does too.
    off = np.abs(np.angle(np.exp(1j * (outputs - np.asarray(expected))))).max(axis=1)
    assert np.mean(off < TOLERANCE) >= (1.0 if preset == "paper" else 0.99)
    assert len(np.unique(np.round(outputs, 3), axis=0)) > 100


def test_a_mapper_of_an_environment_with_an_inner_loop_is_a_function(tmp_path):
    mapper_run(tmp_path / "run", world="nominal")
    assert exported_function(ExportConfig(str(tmp_path / "run"))).kind == "pose_mapper"
    with pytest.raises(ValueError, match="trainer=ppo with .*, got one of trainer=pose_mapper with an inner loop"):
        prepare_controller(tmp_path / "run")


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("mapper") / "run"
    mapper_run(run_dir)
    return run_dir


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "out: expected a file"),
        (["out=new.onnx", "run="], "run: expected a run directory, as in run=runs/NAME"),
        (["out=new.onnx", "run=missing"], "run: expected a run directory, which has a config.yaml, or one of panda"),
        ([f"out={__file__}"], "exists; name a new file"),
        (["out=new.pdf"], "out: expected a file that ends in .onnx, got 'new.pdf'"),
        (["out=no/new.onnx"], "there is no folder 'no'"),
        (["out=new.onnx", "format=tflite"], "expected one of onnx, controller, got 'tflite'"),
    ],
)
def test_bad_input_is_rejected(mapped, reason, arguments, message):
    assert message in reason("export", f"run={mapped}", *arguments)


def test_a_policy_of_many_arms_is_rejected(reason, tmp_path):
    (tmp_path / "run").mkdir()
    save_config(tmp_path / "run", TrainConfig(mimic.env_config("panda_family"), PPOConfig(preset="any_arm").resolve()))
    message = reason("export", f"run={tmp_path / 'run'}", "out=new.onnx")
    assert "run: expected a policy of one arm, or a pose mapper" in message


def test_bad_input_is_one_line(mapped, rejected):
    assert "checkpoint: expected one of 5, the steps that" in rejected(
        "export", f"run={mapped}", "out=new.onnx", "checkpoint=6"
    )


def test_a_mapper_whose_arms_differ_from_its_config_is_rejected(mapped, reason, tmp_path):
    run_dir = shutil.copytree(mapped, tmp_path / "run")
    config = PoseMapperConfig(preset="paper", hidden_layers=[16, 16]).resolve()
    save_config(run_dir, TrainConfig(mimic.env_config("panda3dof"), config))
    assert "it has other arms or another network" in reason("export", f"run={run_dir}", "out=new.onnx")


def test_a_missing_package_is_named(mapped, reason, monkeypatch):
    monkeypatch.setitem(sys.modules, "jax2onnx", None)
    message = reason("export", f"run={mapped}", "out=new.onnx")
    assert "format=onnx needs the package jax2onnx: pip install 'mimic-arms[export]'" in message
