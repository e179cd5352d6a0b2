"""Controllers without learning: holding the start pose, and feedback control along optimal poses."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array, Float

from mimic.any_arm.controller import nearest_pose_controller
from mimic.arms.simulation_model import effective_inertia
from mimic.envs import dynamics
from mimic.envs.imitation import ImitationEnv, arm_state
from mimic.evaluation.evaluator import Controller, Evaluator, Rollouts
from mimic.retargeting.motions import largest_jump, optimal_motions

_FREQUENCIES = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0)  # candidates [rad/s]; a torque is constant for 0.1 s

_Law = Callable[[Array, Array, Array], Array]  # (desired acceleration, qpos, qvel) -> torque


def run_controller(evaluator: Evaluator, name: str) -> tuple[Rollouts, float]:
    """Runs a controller without learning on all demonstrations.

    - "hold": zero torque; the arm stays at rest in its home pose.
    - "pd": proportional-derivative feedback of each joint along the poses of `imitate_trajectory`, scaled by the
      joint's effective inertia in the home pose. The controller has no other model of the dynamics.
    - "computed_torque": the same feedback through the arm's exact inverse dynamics, with feed-forward.
    - "nearest_pose": inverse dynamics to one of the poses nearest to the expert's at the next step, which are followed
      from step to step. In contrast to "pd" and "computed_torque" it does not know the motion in advance, see
      `nearest_pose_controller`.

    "pd" and "computed_torque" are critically damped. Of several frequencies, the one with the smallest distance on the
    training demonstrations is used.

    Args:
      evaluator: evaluator of the environment and its demonstrations.
      name: "hold", "pd", "computed_torque" or "nearest_pose".

    Returns:
      Rollouts of the controller, and its frequency [rad/s], 0 for one that has none.

    Raises:
      ValueError: an arm or a metric that "nearest_pose" does not support.
    """
    env = evaluator.env
    if name == "hold":
        zero = jnp.zeros(env.action_size)
        return jax.jit(lambda: evaluator.rollout(lambda state: zero))(), 0.0
    if name == "nearest_pose":
        controller = nearest_pose_controller(env)
        return jax.jit(lambda: evaluator.rollout(controller))(), 0.0
    make_controller = _tracking(env, {"pd": _joint_law, "computed_torque": _inverse_dynamics_law}[name](env))
    run = jax.jit(lambda frequency: evaluator.rollout(make_controller(frequency)))
    candidates = [(run(frequency), frequency) for frequency in _FREQUENCIES]
    part = evaluator.parts["train"]
    return min(candidates, key=lambda candidate: float(np.asarray(candidate[0].distance)[part].mean()))


def reference_motions(
    env: ImitationEnv,
) -> tuple[Float[np.ndarray, "demonstrations samples joints"], Float[np.ndarray, "demonstrations samples joints"]]:
    """Angles and velocities of the optimal poses of all demonstrations, as continuous motions."""
    qpos = jnp.asarray(env.demonstrations.qpos, jnp.float32)
    jump = largest_jump(env.learner, env.config.control_dt)
    motions = optimal_motions(env.expert, env.learner, qpos, env.config.metric, jump, seed=0)
    angles = np.asarray(motions.qpos, float)
    return angles, np.gradient(angles, env.config.control_dt, axis=1)


def _tracking(env: ImitationEnv, law: _Law) -> Callable[[Array], Controller]:
    """A function from a frequency to a controller: feedback along the reference motion, and its acceleration."""
    dt = env.config.control_dt
    qpos, qvel = (jnp.asarray(x, jnp.float32) for x in reference_motions(env))

    def make(frequency: Array) -> Controller:
        def controller(state: State) -> Array:
            arm = arm_state(state)
            motion, now = arm.demonstration, arm.step
            position_error, velocity_error = qpos[motion, now] - arm.qpos, qvel[motion, now] - arm.qvel
            acceleration = (qvel[motion, now + 1] - qvel[motion, now]) / dt
            desired = acceleration + frequency**2 * position_error + 2 * frequency * velocity_error
            return law(desired, arm.qpos, arm.qvel) / env.torque_scale

        return controller

    return make


def _joint_law(env: ImitationEnv) -> _Law:
    inertia = jnp.asarray(effective_inertia(env.arm.model, np.asarray(env.learner.home)), jnp.float32)
    return lambda acceleration, qpos, qvel: inertia * acceleration


def _inverse_dynamics_law(env: ImitationEnv) -> _Law:
    arm = dynamics.segments(env.arm.model)

    def law(acceleration: Array, qpos: Array, qvel: Array) -> Array:
        return jnp.stack(dynamics.inverse(arm, list(qpos), list(qvel), list(acceleration)))

    return law
