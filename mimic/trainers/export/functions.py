"""Trained networks as functions of vectors, with what their inputs and outputs mean."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from mimic.arms.arrays import MAX_JOINTS, ArmArrays
from mimic.arms.description import described_arm, description, description_layout, description_size
from mimic.arms.embodiment import Embodiment
from mimic.base.distribution import VERSION
from mimic.envs.imitation import layout_of, observation_layout, torque_scale
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.pose_mapper.mapper import PoseMapper
from mimic.trainers.ppo import ppo
from mimic.trainers.ppo.trainer import run_environment

_LEARNER = "description of an arm, see learner_layout; mimic.export with learner=ARM writes it"
_ANGLES = "rad, from base to tip, with those of locked joints; 0 where the arm has no joint"
_SAMPLES = 4  # arms that the exported function of any arm is checked with: each call takes a tenth of a second


@dataclasses.dataclass(frozen=True)
class ExportedFunction:
    """A function to export.

    Attributes:
      function: maps one float32 vector for each input to the named output vectors.
      kind: "policy" or "pose_mapper".
      inputs: length of each input by its name.
      metadata: meaning and units of inputs and outputs.
      samples: [samples, length] values of each input. Default None: normal numbers are such.
      has_batch: whether it is exported for any number of samples at once, or for one.
    """

    function: Callable[..., dict[str, jax.Array]]
    kind: str
    inputs: dict[str, int]
    metadata: dict[str, Any]
    samples: dict[str, np.ndarray] | None = None
    has_batch: bool = True


def make_function(trained: TrainConfig, run_dir: Path, steps: int) -> ExportedFunction:
    """Makes the function of a run's network.

    Args:
      trained: config of the run.
      run_dir: run directory.
      steps: of the checkpoint, which exists.
    """
    exported = (_policy if trained.trainer.name == "ppo" else _mapper)(trained, run_dir, steps)
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
    if trained.env.observation.terms or trained.env.environment:
        layout = layout_of(run_environment(trained.env, run_dir)[0])
    else:
        layout = observation_layout(expert, learner, trained.env.preview)
    size = layout[-1]["stop"]
    config = cast(PPOConfig, trained.trainer)
    params = load_checkpoint(run_dir, ppo.params_template(config, size, learner.num_joints), steps)[1]
    controller = ppo.make_controller(config, size, learner.num_joints)(jax.device_get(params))
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


def _mapper(trained: TrainConfig, run_dir: Path, steps: int) -> ExportedFunction:
    """A pose mapper; where it takes any learner, with the description of an arm as an input."""
    mapper = PoseMapper.load(run_dir, steps)
    model, params, expert = mapper.model, jax.device_get(mapper.params), mapper.model.expert

    def function(expert_qpos: jax.Array, learner: jax.Array | None = None) -> dict[str, jax.Array]:
        pair = model.pair(None if learner is None else described_arm(learner))
        return {"learner_qpos": model(params, pair.target(expert.in_slots(expert_qpos)))}

    metadata: dict[str, Any] = {
        "inputs": {"expert_qpos": "rad, in the order of expert_joints"},
        "expert_range": _joint_ranges(mapper.expert),
    }
    inputs = {"expert_qpos": mapper.expert.num_joints}
    if model.learner is not None:
        metadata |= _names(mapper.expert, mapper.learner) | {"learner_range": _joint_ranges(mapper.learner)}
        metadata["outputs"] = {"learner_qpos": "rad, in the order of learner_joints"}
        return ExportedFunction(function, "pose_mapper", inputs, metadata)
    metadata |= _names(mapper.expert) | {"learner_layout": description_layout()}
    metadata["inputs"]["learner"], metadata["outputs"] = _LEARNER, {"learner_qpos": _ANGLES}
    inputs["learner"] = description_size()
    samples = _arm_samples(inputs, expert.data)
    return ExportedFunction(function, "pose_mapper", inputs, metadata, samples, has_batch=False)


def _arm_samples(inputs: Mapping[str, int], arm: ArmArrays) -> dict[str, np.ndarray]:
    """Inputs of the function of any arm: random numbers in [0, 1], and an arm with random locked joints."""
    rng = np.random.default_rng(0)
    samples = {name: rng.uniform(size=(_SAMPLES, size)) for name, size in inputs.items()}
    locks = (rng.uniform(size=(_SAMPLES, MAX_JOINTS)) > 0.2) * np.asarray(arm.is_free)
    arms = [dataclasses.replace(arm, is_free=is_free) for is_free in locks]
    samples["learner"] = np.stack([description(arm) for arm in arms])
    return samples


def _names(expert: Embodiment, learner: Embodiment | None = None) -> dict[str, Any]:
    """Names of the arms and their joints, for metadata."""
    names: dict[str, Any] = {"expert": expert.name, "expert_joints": list(expert.joint_names)}
    return names | ({"learner": learner.name, "learner_joints": list(learner.joint_names)} if learner else {})


def _joint_ranges(arm: Embodiment) -> Sequence[Sequence[float]]:
    """Minimum and maximum angle of each joint [rad], for metadata."""
    return [[float(bound) for bound in bounds] for bounds in arm.joint_range]
