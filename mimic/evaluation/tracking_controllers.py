"""Controllers without learning: holding the start pose, and feedback control along optimal poses."""

import functools
from collections.abc import Callable, Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array, Float, Int

from mimic.arms.simulation_model import effective_inertia
from mimic.control.joint_control import action_towards
from mimic.envs.imitation import ImitationEnv, arm_state
from mimic.envs.world_env import HardwareEnv
from mimic.envs.world_state import HardwareState
from mimic.evaluation.evaluator import Controller, Evaluator, Motions, Rollouts
from mimic.evaluation.nearest_pose_controller import nearest_pose_controller
from mimic.evaluation.predictive_controller import predictive_controller
from mimic.physics import dynamics
from mimic.physics.joint_numbers import joints_of_model
from mimic.retargeting.motions import largest_jump, optimal_motions
from mimic.retargeting.pose import shared_joints

_FREQUENCIES = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0)  # candidates [rad/s]; a torque is constant for 0.1 s
_LEADS = range(1, 14)  # candidates [ticks]; delays of the hardware world are up to 6

_NEWTON_STEPS = 3  # of a torque towards a pose; the inertia changes little in a control step

_Law = Callable[[Array, Array, Array], Array]  # (desired acceleration, qpos, qvel) -> torque


def run_controller(evaluator: Evaluator, name: str) -> tuple[Rollouts, dict[str, float]]:
    """Runs a controller without learning on all demonstrations.

    - "hold": zero torque; the arm stays at rest in its home pose.
    - "pd": proportional-derivative feedback of each joint along the poses of `imitate_trajectory`, scaled by the
      joint's effective inertia in the home pose. The controller has no other model of the dynamics.
    - "computed_torque": the same feedback through the arm's exact inverse dynamics, with feed-forward.
    - "nearest_pose": inverse dynamics to one of the poses nearest to the expert's at the next step, which are followed
      from step to step. In contrast to the others it does not know the motion in advance, see
      `nearest_pose_controller`.
    - "copy_joints": the same feedback as "computed_torque" along the expert's own angles of the joints that both have.
    - "one_step": the torque that brings the arm to the pose of the kinematic bound at the end of each step, by exact
      dynamics.
    - "mpc": torques that minimise the metric over the next steps that a policy observes, see `predictive_controller`.
    - "tracking": targets of an inner loop along the poses of the kinematic bound, see `tracking_controller`.

    "pd", "computed_torque" and "copy_joints" are critically damped. Of several frequencies, and of several leads of
    "tracking", the one with the smallest distance on the training demonstrations is used.

    Args:
      evaluator: evaluator of the environment and its demonstrations.
      name: "hold"; "tracking" where actions are targets of an inner loop other than torques; the others where they are
        torques.

    Returns:
      Rollouts of the controller, and its setting as an entry of the report: `frequency_rad_s`, 0 for one that has none,
      or `lead_ticks`.

    Raises:
      ValueError: an arm or a metric that "nearest_pose" does not support.
    """
    env = evaluator.env
    if name == "hold":
        zero = jnp.zeros(env.action_size)
        return jax.jit(lambda: evaluator.rollout(lambda state: zero))(), {"frequency_rad_s": 0.0}
    if name in ("nearest_pose", "mpc"):
        controller = (nearest_pose_controller if name == "nearest_pose" else predictive_controller)(env)
        return jax.jit(lambda: evaluator.rollout(controller))(), {"frequency_rad_s": 0.0}
    if name == "tracking":
        rollouts, lead = run_tracking(evaluator)
        return rollouts, {"lead_ticks": lead}
    if name == "one_step":
        one_step = one_step_controller(env, evaluator.nearest_poses)
        return jax.jit(lambda: evaluator.rollout(one_step))(), {"frequency_rad_s": 0.0}
    motions = copied_motions(env) if name == "copy_joints" else reference_motions(env)
    make_controller = _feedback(env, (_joint_law if name == "pd" else _inverse_dynamics_law)(env), motions)
    rollouts, frequency = best_setting(evaluator, make_controller, _FREQUENCIES)
    return rollouts, {"frequency_rad_s": frequency}


def run_tracking(evaluator: Evaluator, *, is_delayed: bool = False) -> tuple[Rollouts, int]:
    """Rollouts of `tracking_controller` with the best of several leads, and this lead [ticks]."""
    env, poses = cast(HardwareEnv, evaluator.env), evaluator.nearest_poses
    make = functools.partial(tracking_controller, env, poses, is_delayed=is_delayed)
    rollouts, lead = best_setting(evaluator, make, _LEADS)
    return rollouts, int(lead)


def tracking_controller(
    env: HardwareEnv, poses: Motions, lead: Int[Array, ""] | int, *, is_delayed: bool = False
) -> Controller:
    """A controller that moves the reference of the inner loop towards the pose that is `lead` ticks ahead.

    See `action_towards`. It knows the poses of the whole motion, and the reference itself in place of a measurement.

    Args:
      env: the environment; its targets are not torques.
      poses: poses of the learner after each tick [rad].
      lead: ticks; more than 1 makes up for delays.
      is_delayed: whether it knows the reference as late as a policy observes it.
    """
    table, mode = jnp.asarray(poses, jnp.float32), env.config.control

    def controller(state: State) -> Array:
        episode = cast(HardwareState, arm_state(state))
        ahead = jnp.minimum(episode.step + lead, table.shape[1]) - 1
        measured = episode.measured[episode.draw.observation_delay if is_delayed else 0]
        displacement = table[episode.demonstration, ahead] - jnp.split(measured, 4)[2]
        return action_towards(mode, displacement, lead * env.config.control_dt, env.parameters, jnp)

    return controller


def one_step_controller(env: ImitationEnv, poses: Motions) -> Controller:
    """A controller that brings the arm to the next of the given poses within one control step, by exact dynamics.

    It has no regard for the velocity there, nor for what follows.

    Args:
      env: the environment; its actions are torques.
      poses: poses of the learner after each step [rad].
    """
    table, law, dt = jnp.asarray(poses, jnp.float32), _inverse_dynamics_law(env), env.config.control_dt

    def controller(state: State) -> Array:
        arm = arm_state(state)
        target = table[arm.demonstration, jnp.minimum(arm.step, table.shape[1] - 1)]

        def improve(acceleration: Array, _: None) -> tuple[Array, None]:
            torque = jnp.clip(law(acceleration, arm.qpos, arm.qvel) / env.torque_scale, -1.0, 1.0)
            after = arm_state(env.step(state, torque))
            return acceleration + 2 / dt**2 * (target - after.qpos), None

        acceleration = 2 / dt**2 * (target - arm.qpos - dt * arm.qvel)
        acceleration, _ = jax.lax.scan(improve, acceleration, None, length=_NEWTON_STEPS)
        return law(acceleration, arm.qpos, arm.qvel) / env.torque_scale

    return controller


def best_setting(
    evaluator: Evaluator, make: Callable[[Array], Controller], settings: Sequence[float]
) -> tuple[Rollouts, float]:
    """The rollouts with the smallest distance on the training demonstrations, and the setting of their controller."""
    run, part = jax.jit(lambda setting: evaluator.rollout(make(setting))), evaluator.parts["train"]
    candidates = [(run(setting), setting) for setting in settings]
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


def copied_motions(
    env: ImitationEnv,
) -> tuple[Float[np.ndarray, "demonstrations samples joints"], Float[np.ndarray, "demonstrations samples joints"]]:
    """Angles and velocities of all demonstrations in the joints that both arms have; see `shared_joints`."""
    motions = env.demonstrations
    qpos, qvel = (shared_joints(env.expert, env.learner, x) for x in (motions.qpos, motions.qvel))
    return qpos, qvel


def _feedback(env: ImitationEnv, law: _Law, motions: tuple[np.ndarray, np.ndarray]) -> Callable[[Array], Controller]:
    """A function from a frequency to a controller: feedback along the given motions, and their acceleration."""
    dt = env.config.control_dt
    qpos, qvel = (jnp.asarray(x, jnp.float32) for x in motions)

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
    joints = joints_of_model(env.arm.model)

    def law(acceleration: Array, qpos: Array, qvel: Array) -> Array:
        return jnp.stack(dynamics.inverse(joints, list(qpos), list(qvel), list(acceleration)))

    return law
