"""A controller of any arm without learning: at each step towards the pose nearest to the expert's next one."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array, Float

from mimic.any_arm.arrays import MAX_JOINTS, MAX_LINKS, arm_arrays
from mimic.any_arm.control import Targets, tracking_torque
from mimic.any_arm.kinematics import check_metric, correspondence
from mimic.any_arm.nearest import nearest_pose
from mimic.arms.arm import build_arm
from mimic.envs.arm_state import arm_state
from mimic.envs.imitation import ImitationEnv

NEWTON_STEPS = 3  # of the nearest pose; 1 gives a gap of 0.16 instead of 0.14 % on panda4dof, 8 gives 0.13 %


def nearest_pose_controller(env: ImitationEnv) -> Callable[[State], Float[Array, " joints"]]:
    """A function from a state of the environment to an action.

    It knows the learner's model and the expert's state at the next step, as a policy with `preview=1` observes it, and
    nothing of the demonstration beyond. See `nearest_pose` and `tracking_torque`. It finds a local minimum of the
    metric, the one that Newton steps from the arm's own pose lead to.

    Args:
      env: the environment.

    Raises:
      ValueError: a tree, an arm with more joints or links than `ArmArrays` has, or another metric than the default one.
    """
    config = env.config
    expert = build_arm(config.expert, config.limits, config.metric.links)
    weights = check_metric(config.metric)
    expert_arm, arm = (_constants(arm_arrays(x)) for x in (expert, env.arm))
    with jax.ensure_compile_time_eval():
        matrix = np.asarray(correspondence(expert_arm, arm))
    joints, dt = env.action_size, config.control_dt

    def controller(state: State) -> Array:
        now = arm_state(state)
        qpos, qvel, max_torque = (_padded(x, MAX_JOINTS) for x in (now.qpos, now.qvel, env.torque_scale))
        next_states = jax.tree.map(lambda x: _padded(x, MAX_LINKS), env.expert_at(now.demonstration, now.step + 1))
        guess = qpos + 0.5 * dt * qvel
        targets = nearest_pose(arm, weights, jnp.asarray(matrix), next_states, guess, NEWTON_STEPS)
        torque = tracking_torque(arm, qpos, qvel, Targets(*targets), max_torque, dt)
        return torque[:joints] / env.torque_scale

    return controller


def _constants(arm: Any) -> Any:
    return jax.tree.map(jnp.asarray, arm.astype(np.float32))


def _padded(values: Array, size: int) -> Array:
    return jnp.concatenate([values, jnp.zeros((size - len(values), *values.shape[1:]), values.dtype)])
