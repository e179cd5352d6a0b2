"""Controllers of one arm that know its model: towards the pose nearest to the next of the expert, or a policy."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS, arm_arrays, masked_arrays
from mimic.envs.arm_state import arm_state
from mimic.envs.imitation import ImitationEnv
from mimic.envs.many_arms_control import make_plan, max_speed, planned_torque
from mimic.envs.many_arms_observation import observe
from mimic.metric.config import check_metric
from mimic.metric.correspondence import arc_length_correspondence
from mimic.retargeting.array_goals import Goals, Problem, chosen_goal, first_goals, next_goals, random_numbers

Policy = Callable[[Float[Array, " observation"]], Float[Array, " actions"]]


class ControllerWithMemory(NamedTuple):
    """A controller that keeps something from step to step.

    Attributes:
      start: its memory at the start of an episode, from the state there.
      act: (state, memory) -> (action, memory).
    """

    start: Callable[[State], Any]
    act: Callable[[State, Any], tuple[Float[Array, " joints"], Any]]


def nearest_pose_controller(env: ImitationEnv, policy: Policy | None = None) -> ControllerWithMemory:
    """The controller of `AnyArmEnv` for the environment of one arm.

    It knows the learner's model and the expert's state at the next step, as a policy with `preview=1` observes it, and
    nothing of the demonstration beyond. See `next_goals` and `make_plan`.

    Args:
      env: the environment of the arm.
      policy: policy of any arm, trained on `AnyArmEnv`: from its observation to its action; the zero action where None.
        With a policy, joints that the config locks keep their places, as in training, see `masked_arrays`.

    Raises:
      ValueError: a tree, an arm with more joints or links than `ArmArrays` has, or another metric than the default one.
    """
    config = env.config
    expert = config.build_arm("expert")
    hand_rotation = env.metric.hand_weights.rotation
    weights = check_metric(dataclasses.replace(config.metric, hand_rotation=0.0))
    if policy is None:
        arrays = arm_arrays(env.arm)
    else:
        arrays, _ = masked_arrays(config.learner, config.limits, config.metric.links)
    with jax.ensure_compile_time_eval():
        expert_arm, arm = (jax.tree.map(jnp.asarray, x.astype(np.float32)) for x in (arm_arrays(expert), arrays))
        matrix = np.asarray(arc_length_correspondence(expert_arm, arm))
        speed = max_speed(arm, config.limits)
    places = np.flatnonzero(arrays.is_free)  # of the environment's joints
    dt = config.control_dt

    def start(state: State) -> Goals:
        return first_goals(arm.home.at[places].set(arm_state(state).qpos))

    def act(state: State, goals: Goals) -> tuple[Array, Goals]:
        now = arm_state(state)
        qpos = arm.home.at[places].set(now.qpos)
        qvel, max_torque = (jnp.zeros(MAX_JOINTS).at[places].set(x) for x in (now.qvel, env.torque_scale))
        own_states = env.expert_at(now.demonstration, now.step + 1)
        next_states = jax.tree.map(lambda x: _padded(x, MAX_LINKS), own_states)
        problem = Problem(arm, weights, jnp.asarray(matrix), next_states, dt, hand_rotation)
        goals = next_goals(problem, goals, qpos, random_numbers(now.key, now.step))
        plan = make_plan(arm, qpos, qvel, goals.goal, speed, dt)
        if policy is None:
            action = jnp.zeros(MAX_JOINTS)
        else:
            action = policy(observe(arm, own_states, qpos, qvel, goals, max_torque, plan, dt))
        torque = planned_torque(arm, plan, action, max_torque, dt)
        return torque[places] / env.torque_scale, chosen_goal(goals)

    return ControllerWithMemory(start, act)


def _padded(values: Array, size: int) -> Array:
    return jnp.concatenate([values, jnp.zeros((size - len(values), *values.shape[1:]), values.dtype)])
