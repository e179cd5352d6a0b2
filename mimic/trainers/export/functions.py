"""Trained networks as functions of vectors, with what their inputs and outputs mean."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp

from mimic.arms.embodiment import Embodiment
from mimic.base.distribution import VERSION
from mimic.envs.imitation import layout_of, torque_scale
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.pose_mapper.mapper import PoseMapper
from mimic.trainers.ppo import ppo
from mimic.trainers.ppo.trainer import run_environment


@dataclasses.dataclass(frozen=True)
class ExportedFunction:
    """A function to export.

    Attributes:
      function: maps one float32 vector for each input to the named output vectors.
      kind: "policy" or "pose_mapper".
      inputs: length of each input by its name.
      metadata: meaning and units of inputs and outputs.
    """

    function: Callable[..., dict[str, jax.Array]]
    kind: str
    inputs: dict[str, int]
    metadata: dict[str, Any]


def make_function(trained: TrainConfig, run_dir: Path, steps: int) -> ExportedFunction:
    """Makes the function of a run's network.

    Args:
      trained: config of the run.
      run_dir: run directory.
      steps: of the checkpoint, which exists.
    """
    exported = _policy(trained, run_dir, steps) if trained.trainer.name == "ppo" else _mapper(run_dir, steps)
    common = {
        "mimic_version": VERSION,
        "env": trained.env.name,
        "trainer": trained.trainer.name,
        "checkpoint": steps,
    }
    return dataclasses.replace(exported, metadata=common | exported.metadata)


def _policy(trained: TrainConfig, run_dir: Path, steps: int) -> ExportedFunction:
    arms = trained.env.build_arms()
    expert, learner = map(trained.env.metric.compared, arms.embodiments)
    env = run_environment(trained.env, run_dir)[0]
    layout, size = layout_of(env), env.observation_size
    config = cast(PPOConfig, trained.trainer)
    template = ppo.params_template(config, size, env.action_size, env.privileged_size)
    params = load_checkpoint(run_dir, template, steps)[1]
    controller = ppo.make_controller(config, size, env.action_size)(jax.device_get(params))
    scale = jnp.asarray(torque_scale(arms.learner, trained.env.action_scale, trained.env.control_dt))

    def function(observation: jax.Array) -> dict[str, jax.Array]:
        action = controller(SimpleNamespace(obs=observation))  # type: ignore[arg-type]
        return {"action": action, "torque": action * scale}

    metadata = {
        **_names(expert, learner),
        "inputs": {"observation": "see observation_layout"},
        "outputs": {
            "action": "fraction of the maximum torque of each joint, in [-1, 1]",
            "torque": "N m, in addition to gravity compensation; constant for control_dt",
        },
        "observation_layout": layout,
        "torque_scale": [float(torque) for torque in scale],
        "control_dt": trained.env.control_dt,
    }
    return ExportedFunction(function, "policy", {"observation": size}, metadata)


def _mapper(run_dir: Path, steps: int) -> ExportedFunction:
    mapper = PoseMapper.load(run_dir, steps)

    def function(expert_qpos: jax.Array) -> dict[str, jax.Array]:
        return {"learner_qpos": mapper.model(mapper.params, expert_qpos)}

    metadata: dict[str, Any] = {
        **_names(mapper.expert, mapper.learner),
        "inputs": {"expert_qpos": "rad, in the order of expert_joints"},
        "outputs": {"learner_qpos": "rad, in the order of learner_joints"},
        "expert_range": _joint_ranges(mapper.expert),
        "learner_range": _joint_ranges(mapper.learner),
    }
    inputs = {"expert_qpos": mapper.expert.num_joints}
    return ExportedFunction(function, "pose_mapper", inputs, metadata)


def _names(expert: Embodiment, learner: Embodiment) -> dict[str, Any]:
    """Names of the arms and their joints, for metadata."""
    arms = {"expert": expert, "learner": learner}
    names: dict[str, Any] = {role: arm.name for role, arm in arms.items()}
    return names | {f"{role}_joints": list(arm.joint_names) for role, arm in arms.items()}


def _joint_ranges(arm: Embodiment) -> Sequence[Sequence[float]]:
    """Minimum and maximum angle of each joint [rad], for metadata."""
    return [[float(bound) for bound in bounds] for bounds in arm.joint_range]
