"""`python -m mimic.export format=controller`: a policy with what a robot needs beside it, for `mimic.deploy`."""

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from mimic.arms.drives import drives_of
from mimic.base.distribution import VERSION
from mimic.control import joint_control
from mimic.control.joint_control import JointParameters
from mimic.deploy.bundle import write_bundle
from mimic.deploy.policy import OBSERVED
from mimic.deploy.safety import check_supported
from mimic.envs.imitation import observed_parts
from mimic.envs.world_env import SENT_ACTIONS, HardwareEnv, control_observation
from mimic.metric.capsule_distances import clearance_constants
from mimic.metric.kinematics import LinkStates
from mimic.runs.checkpoints import check_checkpoint, load_checkpoint
from mimic.trainers.config import PPOConfig
from mimic.trainers.export.onnx_model import to_onnx
from mimic.trainers.ppo import ppo
from mimic.trainers.ppo.trainer import run_environment
from mimic.trainers.run_config import load_config


def prepare_controller(run_dir: Path, checkpoint: int | None = None) -> Callable[[Path], None]:
    """Restores a run; the returned function writes its controller to a new folder, complete or not at all.

    Args:
      run_dir: run directory of a policy with an inner loop (`env.control`, `world`).
      checkpoint: steps of the checkpoint. Default None: the last checkpoint.

    Raises:
      ValueError: a run of another kind, one that the safety layer cannot run, or a checkpoint that does not exist.
    """
    trained = load_config(run_dir, "run")
    config = trained.trainer
    if not isinstance(config, PPOConfig) or trained.env.kind != "inner_loop":
        raise ValueError(
            "format=controller: expected a run of trainer=ppo with an inner loop, as of world=hardware, got one of "
            f"trainer={config.name} with {'an' if trained.env.kind == 'inner_loop' else 'no'} inner loop"
        )
    check_supported(trained.env.control, trained.env.control_dt)
    for key, expected in (("history", 0), ("expert", "exact")):  # a robot's controller knows neither past nor noise
        value = getattr(trained.env.world, key)
        if value != expected:
            raise ValueError(f"format=controller: expected a run of env.world.{key}={expected}, got {value}")
    steps = check_checkpoint(run_dir, checkpoint)
    env = cast(HardwareEnv, run_environment(trained.env, run_dir)[0])
    template = ppo.params_template(config, env.observation_size, env.action_size, env.privileged_size)
    params = load_checkpoint(run_dir, template, steps)[1]

    def write(out: Path) -> None:
        partial = Path(tempfile.mkdtemp(prefix=".mimic-", dir=out.absolute().parent))
        try:
            write_bundle(
                partial / "bundle",
                policy=_policy_graph(env, config, jax.device_get(params)),
                clearance=clearance_constants(env.learner, env.capsules, env.world.floor_height),
                controller=_description(env, steps),
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


def _policy_graph(env: HardwareEnv, config: PPOConfig, params: Any) -> bytes:
    """The policy, of what is measured, its last actions, and the expert's states now and in the preview."""
    act = ppo.make_controller(config, env.observation_size, env.action_size)(params)

    def action(*values: jax.Array) -> dict[str, jax.Array]:
        *measured, past_actions, expert = values
        observation = control_observation(env, jnp.concatenate(measured), past_actions, expert)
        return {"action": act(SimpleNamespace(obs=observation))}  # type: ignore[arg-type]

    inputs: dict[str, int] = dict.fromkeys(OBSERVED, env.learner.num_joints)
    inputs |= {
        "past_actions": SENT_ACTIONS * env.action_size,
        "expert": (env.config.preview + 1) * expert_table(env).shape[-1],
    }
    return to_onnx(action, name="policy", inputs=inputs, metadata={"mimic_version": VERSION})


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
