"""What a user would do without learning: hold still, or track the optimal poses with a feedback controller."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array, Float

from mimic.arms.simulation_model import effective_inertia
from mimic.envs import dynamics
from mimic.envs.imitation import ImitationEnv, arm_state
from mimic.evaluation.evaluator import Controller, Evaluator, Rollouts
from mimic.retargeting.motions import largest_jump, optimal_motions

_FREQUENCIES = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0)  # rad/s that are tried; a torque is held for 0.1 s

_Law = Callable[[Array, Array, Array], Array]  # desired acceleration, qpos, qvel -> torque


def run_controller(evaluator: Evaluator, name: str) -> tuple[Rollouts, float]:
    """Runs a controller that is not learned on all demonstrations.

    - "hold": no torque; the arm stays at rest in its home pose.
    - "pd": proportional-derivative feedback onto `imitate_trajectory`'s poses at each joint, with the inertia that the
      joint feels in the home pose: nothing else is known of the dynamics.
    - "computed_torque": the same feedback through the arm's exact inverse dynamics, with feed-forward.

    Both are critically damped. Their frequency is the one of a few that is best on the training demonstrations.

    Args:
      evaluator: of the environment and its demonstrations.
      name: "hold", "pd" or "computed_torque".

    Returns:
      What it did, and its frequency [rad/s].
    """
    env = evaluator.env
    if name == "hold":
        still = jnp.zeros(env.action_size)
        return jax.jit(lambda: evaluator.rollout(lambda state: still))(), 0.0
    make = _tracking(env, {"pd": _joint_law, "computed_torque": _inverse_dynamics_law}[name](env))
    program = jax.jit(lambda frequency: evaluator.rollout(make(frequency)))
    tried = [(program(frequency), frequency) for frequency in _FREQUENCIES]
    part = evaluator.parts["train"]
    return min(tried, key=lambda one: float(np.asarray(one[0].distance)[part].mean()))


def reference_motions(
    env: ImitationEnv,
) -> tuple[Float[np.ndarray, "demonstrations samples joints"], Float[np.ndarray, "demonstrations samples joints"]]:
    """Angles and velocities of the optimal poses of all demonstrations, without a jump."""
    qpos = jnp.asarray(env.demonstrations.qpos, jnp.float32)
    jump = largest_jump(env.learner, env.config.control_dt)
    found = optimal_motions(env.expert, env.learner, qpos, env.config.metric, jump, seed=0)
    angles = np.asarray(found.qpos, float)
    return angles, np.gradient(angles, env.config.control_dt, axis=1)


def _tracking(env: ImitationEnv, law: _Law) -> Callable[[Array], Controller]:
    """A controller for a frequency: feedback onto the reference, and the acceleration that it has in the step."""
    dt = env.config.control_dt
    qpos, qvel = (jnp.asarray(x, jnp.float32) for x in reference_motions(env))

    def make(frequency: Array) -> Controller:
        def controller(state: State) -> Array:
            arm = arm_state(state)
            motion, now = arm.demonstration, arm.step
            position_error, velocity_error = qpos[motion, now] - arm.qpos, qvel[motion, now] - arm.qvel
            acceleration = (qvel[motion, now + 1] - qvel[motion, now]) / dt
            wanted = acceleration + frequency**2 * position_error + 2 * frequency * velocity_error
            return law(wanted, arm.qpos, arm.qvel) / env.torque_scale

        return controller

    return make


def _joint_law(env: ImitationEnv) -> _Law:
    inertia = jnp.asarray(effective_inertia(env.arm.model, np.asarray(env.learner.home)), jnp.float32)
    return lambda wanted, qpos, qvel: inertia * wanted


def _inverse_dynamics_law(env: ImitationEnv) -> _Law:
    arm = dynamics.segments(env.arm.model)

    def law(wanted: Array, qpos: Array, qvel: Array) -> Array:
        return jnp.stack(dynamics.inverse(arm, list(qpos), list(qvel), list(wanted)))

    return law
