"""Controllers of one arm that know its model: towards the pose nearest to the next of the expert, or a policy."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array, Float

from mimic.any_arm.arrays import MAX_JOINTS, MAX_LINKS, ArmArrays, arm_arrays
from mimic.any_arm.control import make_plan, max_speed, planned_torque
from mimic.any_arm.kinematics import check_metric, correspondence
from mimic.any_arm.nearest import nearest_pose
from mimic.any_arm.observation import observe
from mimic.arms.arm import build_arm
from mimic.envs.arm_state import arm_state
from mimic.envs.config import EnvConfig
from mimic.envs.imitation import ImitationEnv

NEWTON_STEPS = 3  # of the nearest pose; 1 gives a gap of 0.16 instead of 0.14 % on panda4dof, 8 gives 0.13 %


def nearest_pose_controller(
    env: ImitationEnv, policy: Callable[[Float[Array, " observation"]], Float[Array, " joints"]] | None = None
) -> Callable[[State], Float[Array, " joints"]]:
    """A function from a state of the environment to an action.

    It knows the learner's model and the expert's state at the next step, as a policy with `preview=1` observes it, and
    nothing of the demonstration beyond. See `nearest_pose` and `tracking_acceleration`. Without a policy it finds a
    local minimum of the metric, the one that Newton steps from the arm's own pose lead to.

    Args:
      env: the environment of the arm.
      policy: policy of any arm, trained on `AnyArmEnv`: from its observation to its action. Joints that the config
        locks then keep their places, see `arrays_with_mask`, so that the policy observes what it did in training.

    Raises:
      ValueError: a tree, an arm with more joints or links than `ArmArrays` has, or another metric than the default one.
    """
    config = env.config
    expert = build_arm(config.expert, config.limits, config.metric.links)
    weights = check_metric(config.metric)
    arrays = arm_arrays(env.arm) if policy is None else arrays_with_mask(config)
    with jax.ensure_compile_time_eval():
        expert_arm, arm = (_constants(x) for x in (arm_arrays(expert), arrays))
        matrix = np.asarray(correspondence(expert_arm, arm))
        speed = max_speed(arm, config.limits)
    places = np.flatnonzero(arrays.is_free)  # of the environment's joints
    dt = config.control_dt

    def controller(state: State) -> Array:
        now = arm_state(state)
        qpos = arm.home.at[places].set(now.qpos)
        qvel, max_torque = (jnp.zeros(MAX_JOINTS).at[places].set(x) for x in (now.qvel, env.torque_scale))
        own_states = env.expert_at(now.demonstration, now.step + 1)
        next_states = jax.tree.map(lambda x: _padded(x, MAX_LINKS), own_states)
        guess = qpos + 0.5 * dt * qvel
        targets = nearest_pose(arm, weights, jnp.asarray(matrix), next_states, guess, NEWTON_STEPS)
        plan = make_plan(arm, qpos, qvel, targets, speed, dt)
        if policy is None:
            action = jnp.zeros(MAX_JOINTS)
        else:
            action = policy(observe(arm, own_states, qpos, qvel, targets, max_torque, plan, dt))
        torque = planned_torque(arm, plan, action, max_torque, dt)
        return torque[places] / env.torque_scale

    return controller


def arrays_with_mask(config: EnvConfig) -> ArmArrays:
    """The learner as arrays where locked joints have places of their own, as `lock_joints` makes it.

    Raises:
      ValueError: a tree, or an arm with more joints, locked ones included, or links than `ArmArrays` has.
    """
    limits, links = config.limits, config.metric.links
    whole = build_arm(dataclasses.replace(config.learner, locked=None), limits, links)
    locked = build_arm(config.learner, limits, links).locked
    return arm_arrays(whole, free=[name not in locked for name in whole.embodiment.joint_names])


def _constants(arm: Any) -> Any:
    return jax.tree.map(jnp.asarray, arm.astype(np.float32))


def _padded(values: Array, size: int) -> Array:
    return jnp.concatenate([values, jnp.zeros((size - len(values), *values.shape[1:]), values.dtype)])
