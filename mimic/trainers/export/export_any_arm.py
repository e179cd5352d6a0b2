"""Exports of runs whose learner is any arm: functions with the description of an arm as an input, and descriptions."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from rich.console import Console

from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, ArmArrays, arm_arrays
from mimic.arms.description import (
    SUFFIXES,
    described_arm,
    description_layout,
    description_size,
    save_description,
)
from mimic.base.config import new_file
from mimic.base.distribution import VERSION
from mimic.envs.many_arms_control import make_plan, max_speed, planned_torque, torque_scale
from mimic.envs.many_arms_observation import observation_size, observe
from mimic.metric.array_kinematics import check_metric, correspondence, link_states
from mimic.retargeting.array_goals import NEW_POSES, OTHERS, Problem, chosen_goal, first_goals, next_goals
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.export.exported_function import ExportedFunction, joint_ranges
from mimic.trainers.fine_tuning import with_one_learner
from mimic.trainers.pose_mapper.any_arm_mapper import AnyArmMapper, describe_arm
from mimic.trainers.pose_mapper.any_arm_model import expert_pose
from mimic.trainers.ppo import ppo

_LEARNER = "description of an arm, see learner_layout; mimic.export with learner=ARM writes it"
_ANGLES = "from base to tip, with those of locked joints; 0 where the arm has no joint"
_MEMORY = (1 + OTHERS) * MAX_JOINTS


def any_arm_function(trained: TrainConfig, run_dir: Path, steps: int) -> ExportedFunction:
    """The function of a run whose learner is any arm."""
    make = _policy if trained.trainer.name == "ppo" else _mapper
    return make(trained, run_dir, steps)


def _mapper(trained: TrainConfig, run_dir: Path, steps: int) -> ExportedFunction:
    mapper = AnyArmMapper.load(run_dir, steps)
    params = jax.device_get(mapper.params)

    def function(expert_qpos: jax.Array, learner: jax.Array) -> dict[str, jax.Array]:
        expert = expert_pose(mapper.model.expert, mapper.own_expert.in_slots(expert_qpos))
        return {"learner_qpos": mapper.model(params, expert, described_arm(learner))}

    metadata = {
        **_common(trained, steps, mapper.expert.name, mapper.expert.joint_names),
        "inputs": {"expert_qpos": "rad, in the order of expert_joints", "learner": _LEARNER},
        "outputs": {"learner_qpos": f"rad, {_ANGLES}"},
        "expert_range": joint_ranges(mapper.expert),
        "learner_layout": description_layout(),
    }
    inputs = {"expert_qpos": mapper.expert.num_joints, "learner": description_size()}
    return ExportedFunction(function, "pose_mapper", inputs, metadata)


def _policy(trained: TrainConfig, run_dir: Path, steps: int) -> ExportedFunction:
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
        problem = Problem(arm, weights, correspondence(expert_arrays, arm), states, dt)
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
        **_common(trained, steps, expert.name, expert.joint_names),
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
    return ExportedFunction(function, "policy", inputs, metadata)


def _common(trained: TrainConfig, steps: int, expert: str, expert_joints: Sequence[str]) -> dict[str, Any]:
    return {
        "mimic_version": VERSION,
        "env": trained.env.name,
        "trainer": trained.trainer.name,
        "checkpoint": steps,
        "expert": expert,
        "expert_joints": list(expert_joints),
    }


def description_writer(trained: TrainConfig, learner: str, locked: Sequence[Any], out: str) -> Callable[[], None]:
    """Writes the description of an arm for the exported function of a run whose learner is any arm.

    Args:
      trained: config of the run.
      learner: the arm.
      locked: its locked joints, by number or name.
      out: file to write.

    Raises:
      ValueError: another suffix than those of descriptions, no such arm, or one that the run's function does not take.
    """
    file = new_file("out", out)
    if file.suffix not in SUFFIXES:
        raise ValueError(
            f"out: expected a file {' or '.join(SUFFIXES)} for the description of learner={learner}, got {out!r}; "
            "export the network, which takes any arm, without learner="
        )
    is_policy = trained.trainer.name == "ppo"
    env, arm = trained.env, learner
    if is_policy:
        arm = with_one_learner(env, learner, locked).learner  # of up to 8 joints, locked ones included
    elif locked:
        arm = ArmConfig(model=learner, locked=list(locked))
    described = describe_arm(env, arm)
    arrays = described.arrays
    if is_policy:  # the function would need many times as many operations with the inertia in the home pose
        max_torque = torque_scale(jax.tree.map(jnp.asarray, arrays), env.action_scale, env.control_dt)
        arrays = dataclasses.replace(arrays, torque_limit=np.asarray(max_torque))

    def run() -> None:
        name = described.arm.embodiment.name
        save_description(file, arrays, name, described.slots, has_dynamics=is_policy)
        Console().print(f"results: {file}", soft_wrap=True, highlight=False)

    return run
