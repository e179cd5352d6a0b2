"""What a rollout is compared with: the kinematic bound, holding the start pose, and motions without learning."""

import contextlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.arms.pose_limits import pose_limits
from mimic.base.compilation import compiled_quickly, on_host
from mimic.envs.imitation import ImitationEnv
from mimic.envs.many_arms import AnyArmEnv
from mimic.metric.kinematics import LinkStates, link_state_table, link_states
from mimic.retargeting import array_bound
from mimic.retargeting.exact_chunks import by_chunks
from mimic.retargeting.kinematic_bound import closest_motion
from mimic.retargeting.pose import shared_joints
from mimic.retargeting.pose_baselines import baseline_poses

Motions = Float[np.ndarray, "rows time joints"]
CONTROLLER = "controller"  # the name of the zero action's motions
_CHUNK = 256  # demonstrations whose bound is searched at a time
_FEW = 1024  # demonstrations of which the bound takes less time on the CPU, where it compiles several times faster


class References(NamedTuple):
    """The references of the metrics; a row is a demonstration, or one with one of many arms.

    Attributes:
      bound: [rows, time] the kinematic bound.
      hold: [rows, time] distance of holding the start pose.
      motions: the learner's angles [rows, time, joints] [rad] by name; see `Evaluator.similarity_summary`.
      controller: [rows, time] distance of the zero action of many arms, which is a controller; otherwise None.
    """

    bound: Float[np.ndarray, "rows time"]
    hold: Float[np.ndarray, "rows time"]
    motions: dict[str, Motions]
    controller: Float[np.ndarray, "rows time"] | None = None


def references_of_one_arm(env: ImitationEnv) -> References:
    """The references of an environment of one learner."""
    steps = env.config.horizon
    qpos, qvel = (x[:, 1 : steps + 1] for x in (env.demonstrations.qpos, env.demonstrations.qvel))
    copied_qpos, copied_qvel = (shared_joints(env.expert, env.learner, x) for x in (qpos, qvel))
    copied_qpos = np.clip(copied_qpos, *pose_limits(env.learner, float))
    distance = jax.jit(jax.vmap(jax.vmap(env.states_distance)))
    held_qpos = np.broadcast_to(env.start_poses[:, None], copied_qpos.shape)
    copied, hold = (
        np.asarray(distance(_expert_states(env), link_state_table(env.learner, *motion)))
        for motion in ((copied_qpos, copied_qvel), (held_qpos, np.zeros_like(copied_qvel)))
    )
    # If copying the expert's joints gives distance 0 everywhere, the bound needs no optimisation.
    bound, nearest = _lower_bound(env, qpos, qvel) if copied.any() else (copied, copied_qpos)
    return References(bound, hold, {"nearest_poses": nearest})


def baseline_motions(env: ImitationEnv) -> dict[str, Motions]:
    """The learner's angles of each of `pose_baselines.BASELINES`, in an environment of one learner."""
    return baseline_poses(env.expert, env.learner, env.demonstrations.qpos[:, 1 : env.config.horizon + 1])


def _expert_states(env: ImitationEnv) -> LinkStates:
    """The expert's link states after each step."""
    return jax.tree.map(lambda x: np.asarray(x)[:, 1 : env.config.horizon + 1], env.expert_states)


def _lower_bound(env: ImitationEnv, qpos: Motions, qvel: Motions) -> tuple[np.ndarray, Motions]:
    """The kinematic bound [demonstrations, time], and its poses."""

    def closest(qpos: Array, qvel: Array) -> tuple[Array, Array]:
        solution = closest_motion(env.expert, env.learner, qpos, qvel, **env.metric.arguments)
        return solution.distance, solution.qpos

    # Of many demonstrations in chunks of one size, the last one filled up: all at once, they need too much memory.
    motions = qpos.astype(np.float32), qvel.astype(np.float32)
    with on_host() if len(qpos) <= _FEW else contextlib.nullcontext():
        distance, poses = by_chunks(jax.jit(jax.vmap(closest)), *motions, size=min(len(qpos), _CHUNK))
    return distance, poses


def references_of_arms(
    env: AnyArmEnv, arms: ArmArrays, qpos: Motions, distance: Float[np.ndarray, "rows time"]
) -> References:
    """The references of many arms, from one compiled function.

    Args:
      env: the environment.
      arms: [arms, ...] each.
      qpos: the learners' angles under the zero action [rad], from which the search of the bound starts.
      distance: their distances.
    """
    expert_states, count = _expert_states(env), env.demonstrations.count

    def of_arm(inputs: tuple[ArmArrays, Array]) -> tuple[Array, Array, Array]:
        arm, guesses = inputs
        metric, at_home = env.metric_of(arm), link_states(arm, arm.home)

        def of_demonstration(expert: LinkStates, guess: Array) -> tuple[Array, Array, Array]:
            start = jnp.where(jnp.isfinite(guess), guess, arm.home)
            closest = array_bound.closest_motion(arm, metric, expert, start)
            hold = jax.vmap(lambda state: metric(state, at_home))(expert)
            return closest.distance, hold, closest.qpos

        return jax.vmap(of_demonstration)(expert_states, guesses)

    inputs: Any = jax.tree.map(np.asarray, arms), qpos.reshape(-1, count, *qpos.shape[1:])
    with on_host():  # as the bound of one arm
        # One arm after the other, so that the search takes the memory of one.
        search = compiled_quickly(lambda *inputs: jax.lax.map(of_arm, inputs), *inputs)
        by_arm = jax.tree.map(np.asarray, search(*inputs))
    bound, hold, nearest = (x.reshape(-1, *x.shape[2:]) for x in by_arm)
    home = np.repeat(np.asarray(arms.home), count, axis=0)[:, None]
    motions = {CONTROLLER: qpos, "nearest_poses": nearest, "hold_home": np.broadcast_to(home, qpos.shape)}
    return References(np.minimum(bound, distance), hold, motions, distance)
