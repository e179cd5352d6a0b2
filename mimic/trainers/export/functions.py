"""Trained networks as functions of vectors, with what their inputs and outputs mean."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mimic.arms.arm import build_arm
from mimic.arms.arrays import MAX_JOINTS, ArmArrays, arm_arrays
from mimic.arms.description import described_arm, description, description_layout, description_size
from mimic.arms.embodiment import Embodiment
from mimic.base.distribution import VERSION
from mimic.envs.imitation import layout_of, observation_layout, torque_scale
from mimic.envs.many_arms_control import make_plan, max_speed, planned_torque
from mimic.envs.many_arms_observation import observation_size, observe
from mimic.metric.config import check_metric
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.kinematics import link_states
from mimic.retargeting.array_goals import NEW_POSES, OTHERS, Problem, chosen_goal, first_goals, next_goals
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.pose_mapper.mapper import PoseMapper
from mimic.trainers.ppo import ppo
from mimic.trainers.ppo.trainer import run_environment

_LEARNER = "description of an arm, see learner_layout; mimic.export with learner=ARM writes it"
_ANGLES = "from base to tip, with those of locked joints; 0 where the arm has no joint"
_MEMORY = (1 + OTHERS) * MAX_JOINTS
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
    of_policy = _any_arm_policy if trained.env.kind == "sampled_arms" else _policy
    exported = (of_policy if trained.trainer.name == "ppo" else _mapper)(trained, run_dir, steps)
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
    metadata["inputs"]["learner"], metadata["outputs"] = _LEARNER, {"learner_qpos": f"rad, {_ANGLES}"}
    inputs["learner"] = description_size()
    samples = _arm_samples(inputs, expert.data)
    return ExportedFunction(function, "pose_mapper", inputs, metadata, samples, has_batch=False)


def _any_arm_policy(trained: TrainConfig, run_dir: Path, steps: int) -> ExportedFunction:
    """A step of the controller of any arm with the policy, as in `AnyArmEnv`."""
    env, config = trained.env, cast(PPOConfig, trained.trainer)
    built = build_arm(env.expert, env.limits, env.metric.links)
    expert, weights, dt = built.embodiment, check_metric(env.metric), env.control_dt
    expert_arrays: ArmArrays = jax.tree.map(jnp.asarray, arm_arrays(built).astype(np.float32))
    sizes = observation_size(expert.num_links), MAX_JOINTS
    params = load_checkpoint(run_dir, ppo.params_template(config, *sizes), steps)[1]
    controller = ppo.make_controller(config, *sizes)(jax.device_get(params))

    def function(
        expert_qpos: Array, expert_qvel: Array, learner: Array, qpos: Array, qvel: Array, memory: Array, random: Array
    ) -> dict[str, Array]:
        arm = described_arm(learner)
        motion = (jnp.pad(x, (0, MAX_JOINTS - expert.num_joints)) for x in (expert_qpos, expert_qvel))
        states = link_states(expert_arrays, *motion)
        problem = Problem(arm, weights, arc_length_correspondence(expert_arrays, arm), states, dt)
        poses = memory.reshape(-1, MAX_JOINTS)
        before = first_goals(qpos)
        before = before._replace(goal=before.goal._replace(qpos=poses[0]), others=poses[1:])
        goals = next_goals(problem, before, qpos, random.reshape(NEW_POSES, MAX_JOINTS))
        plan = make_plan(arm, qpos, qvel, goals.goal, max_speed(arm, env.limits), dt)
        max_torque = arm.is_free * arm.torque_limit
        own_states = jax.tree.map(lambda x: x[: expert.num_links], states)
        observation = observe(arm, own_states, qpos, qvel, goals, max_torque, plan, dt)
        action = controller(SimpleNamespace(obs=observation))  # type: ignore[arg-type]
        return {
            "torque": planned_torque(arm, plan, action, max_torque, dt),
            "controller_torque": planned_torque(arm, plan, jnp.zeros_like(action), max_torque, dt),
            "next_memory": jnp.concatenate([chosen_goal(goals).goal.qpos[None], goals.others]).ravel(),
        }

    metadata = {
        **_names(expert),
        "inputs": {
            "expert_qpos": "rad, in the order of expert_joints, control_dt from now",
            "expert_qvel": "rad/s, the same",
            "learner": f"{_LEARNER}; torque_limit is the maximum torque, from mimic.export that of the training",
            "qpos": f"rad, {_ANGLES}",
            "qvel": "rad/s, the same",
            "memory": "next_memory of the step before; at the start qpos, repeated",
            "random": "uniform in [0, 1], new in each step: poses from which other minima are searched",
        },
        "outputs": {
            "torque": "N m, in addition to gravity compensation; constant for control_dt",
            "controller_torque": "the same without the policy",
            "next_memory": "rad, poses that are followed",
        },
        "control_dt": dt,
        "learner_layout": description_layout(has_dynamics=True),
    }
    inputs = {
        **dict.fromkeys(("expert_qpos", "expert_qvel"), expert.num_joints),
        "learner": description_size(has_dynamics=True),
        **dict.fromkeys(("qpos", "qvel"), MAX_JOINTS),
        "memory": _MEMORY,
        "random": NEW_POSES * MAX_JOINTS,
    }
    samples = _arm_samples(inputs, arm_arrays(built), has_dynamics=True)
    return ExportedFunction(function, "policy", inputs, metadata, samples, has_batch=False)


def _arm_samples(inputs: Mapping[str, int], arm: ArmArrays, *, has_dynamics: bool = False) -> dict[str, np.ndarray]:
    """Inputs of the function of any arm: random numbers in [0, 1], and an arm with random locked joints."""
    rng = np.random.default_rng(0)
    samples = {name: rng.uniform(size=(_SAMPLES, size)) for name, size in inputs.items()}
    locks = (rng.uniform(size=(_SAMPLES, MAX_JOINTS)) > 0.2) * np.asarray(arm.is_free)
    arms = [dataclasses.replace(arm, is_free=is_free) for is_free in locks]
    samples["learner"] = np.stack([description(arm, has_dynamics=has_dynamics) for arm in arms])
    return samples


def _names(expert: Embodiment, learner: Embodiment | None = None) -> dict[str, Any]:
    """Names of the arms and their joints, for metadata."""
    names: dict[str, Any] = {"expert": expert.name, "expert_joints": list(expert.joint_names)}
    return names | ({"learner": learner.name, "learner_joints": list(learner.joint_names)} if learner else {})


def _joint_ranges(arm: Embodiment) -> Sequence[Sequence[float]]:
    """Minimum and maximum angle of each joint [rad], for metadata."""
    return [[float(bound) for bound in bounds] for bounds in arm.joint_range]
