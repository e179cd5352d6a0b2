"""`python -m mimic.export format=controller`: a policy with what a robot needs beside it, for `mimic.deploy`."""

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from mimic.arms.drives import drives_of
from mimic.base.distribution import VERSION
from mimic.control import joint_control
from mimic.control.joint_control import JointParameters
from mimic.deploy.bundle import write_bundle
from mimic.deploy.safety import check_supported
from mimic.envs.imitation import link_layout, observed_parts
from mimic.envs.world_env import SENT_ACTIONS, HardwareEnv
from mimic.metric.capsule_distances import clearance_constants
from mimic.metric.kinematics import LinkStates, link_states
from mimic.runs.checkpoints import check_checkpoint, load_checkpoint
from mimic.trainers.config import PPOConfig
from mimic.trainers.export.onnx_model import to_onnx
from mimic.trainers.ppo import ppo
from mimic.trainers.ppo.trainer import run_environment
from mimic.trainers.run_config import load_config


def export_controller(run_dir: Path, out: Path, checkpoint: int | None = None) -> None:
    """Writes the controller of a run to a new folder, complete or not at all.

    Args:
      run_dir: run directory of a policy with an inner loop (`env.control`, `world`).
      out: must not exist.
      checkpoint: steps of the checkpoint. Default None: the last checkpoint.

    Raises:
      ValueError: a run of another kind, one that the safety layer cannot run, or a checkpoint that does not exist.
    """
    prepare_controller(run_dir, checkpoint)(out)


def prepare_controller(run_dir: Path, checkpoint: int | None = None) -> Callable[[Path], None]:
    """Restores a run; the returned function writes its controller, see `export_controller`."""
    trained = load_config(run_dir)
    config = trained.trainer
    if not isinstance(config, PPOConfig) or trained.env.kind != "inner_loop":
        raise ValueError(
            "format=controller: expected a run of trainer=ppo with an inner loop, as of world=hardware, got one of "
            f"trainer={config.name} with {'an' if trained.env.kind == 'inner_loop' else 'no'} inner loop"
        )
    check_supported(trained.env.control, trained.env.control_dt)
    steps = check_checkpoint(run_dir, checkpoint)
    env = cast(HardwareEnv, run_environment(trained.env, run_dir)[0])
    template = ppo.params_template(config, env.observation_size, env.action_size)
    params = load_checkpoint(run_dir, template, steps)[1]

    def write(out: Path) -> None:
        partial = Path(tempfile.mkdtemp(prefix=".mimic-", dir=out.absolute().parent))
        try:
            features, policy = _policy_graphs(env, jax.device_get(params))
            write_bundle(
                partial / "bundle",
                policy=policy,
                features=features,
                clearance=clearance_constants(env.learner, env.capsules, env.world.floor_height),
                controller=_description(env, steps) | {"features": config.hidden_layers[0]},
                expert=expert_table(env),
                start_poses=np.asarray(env.start_poses, float),
                names=[f"demonstration {index}" for index in range(env.demonstrations.count)],
            )
            os.rename(partial / "bundle", out)
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    return write


def expert_table(env: HardwareEnv) -> np.ndarray:
    """The expert's link states [demonstrations, ticks + 1, numbers], as the policy observes them."""
    states: LinkStates = jax.tree.map(lambda x: np.asarray(x)[:, : env.config.horizon + 1], env.expert_states)
    parts = [part.reshape(*part.shape[:2], -1) for part in observed_parts(states)]
    return np.concatenate(parts, axis=-1).astype(np.float32)


def _policy_graphs(env: HardwareEnv, params: Any) -> tuple[bytes, bytes]:
    """What the first layer adds up from the expert's link states, and the policy from that and its other observations.

    The states of the expert are five sixths of an observation and known before a motion. The test of the export
    compares with `control_observation` and the policy of `ppo.make_controller`.
    """
    statistics, policy, *_ = params
    layers = [policy["params"][f"hidden_{index}"] for index in range(len(policy["params"]))]
    layout = link_layout(env.expert, env.learner, env.config.preview)
    own_links = next(part["start"] for part in layout if part["name"].startswith("expert"))
    joints, expert_size = env.learner.num_joints, layout[-1]["stop"] - own_links
    is_expert = np.zeros(env.observation_size, bool)
    is_expert[own_links : own_links + expert_size] = True
    mean = np.array(statistics.mean)
    mean[own_links + expert_size :][:joints] += np.asarray(env.learner.home)  # the policy observes the difference
    first_kernel = np.asarray(layers[0]["kernel"]) / np.asarray(statistics.std)[:, None]

    def first_layer(part: np.ndarray, values: jax.Array) -> jax.Array:
        return (values - mean[part]) @ first_kernel[part]

    def features(expert: jax.Array) -> dict[str, jax.Array]:
        return {"features": first_layer(is_expert, expert) + layers[0]["bias"]}

    def action(*values: jax.Array) -> dict[str, jax.Array]:
        qpos, qvel, reference_qpos, reference_qvel, past_actions, features = values
        states = [part.ravel() for part in observed_parts(link_states(env.learner, qpos, qvel))]
        own = jnp.concatenate([*states, reference_qpos, reference_qvel, past_actions])
        hidden = features + first_layer(~is_expert, own)
        for layer in layers[1:-1]:
            hidden = jax.nn.silu(hidden) @ layer["kernel"] + layer["bias"]
        kernel, bias = (layers[-1][name][..., : env.action_size] for name in ("kernel", "bias"))  # no deviation
        return {"action": jax.lax.clamp(-1.0, jnp.tanh(jax.nn.silu(hidden) @ kernel + bias), 1.0)}

    inputs: dict[str, int] = dict.fromkeys(("qpos", "qvel", "reference_qpos", "reference_qvel"), joints)
    inputs |= {"past_actions": SENT_ACTIONS * env.action_size, "features": len(layers[0]["bias"])}
    metadata = {"mimic_version": VERSION}
    return (
        to_onnx(features, name="features", inputs={"expert": expert_size}, metadata=metadata),
        to_onnx(action, name="policy", inputs=inputs, metadata=metadata),
    )


def _description(env: HardwareEnv, steps: int) -> dict[str, Any]:
    """What `controller.json` has, see `mimic.deploy.bundle.Bundle`."""
    config = env.config
    assert config.control in joint_control.MODES
    parameters = JointParameters(*(np.asarray(x, float) for x in env.plant.constants.parameters))
    return {
        "mimic_version": VERSION,
        "env": config.name,
        "checkpoint": steps,
        "robot": env.learner.name,
        "mode": config.control,
        "control_dt": config.control_dt,
        "joint_names": list(env.learner.joint_names),
        "limits": drives_of(config.learner, env.arm).limits.as_lists(),
        "parameters": {name: x.tolist() for name, x in parameters._asdict().items()},
        "preview": config.preview,
        "past_actions": SENT_ACTIONS,
        "expert_numbers": expert_table(env).shape[-1],
    }
