"""What a policy of any arm observes: numbers of each joint, and numbers of the whole arm and of its expert.

Its length depends on neither the arm's joints nor its links. Nothing of it is known of the expert after the next step.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS, ArmArrays
from mimic.envs.many_arms_control import Plan
from mimic.metric.kinematics import LinkStates, axes_and_origins, frame_table, states_in_frames
from mimic.retargeting.array_goals import Goals

JOINT_FEATURES = 18  # numbers of each joint; the first says whether it is free
_LINK_FEATURES, _EXPERT_FEATURES = 7, 12
_MAX_FEATURE = 10.0


def observation_size(expert_links: int) -> int:
    """Length of an observation: that of `observe`."""
    return 1 + JOINT_FEATURES * MAX_JOINTS + _LINK_FEATURES * MAX_LINKS + _EXPERT_FEATURES * expert_links


def observe(
    arm: ArmArrays,
    expert: LinkStates,
    qpos: Float[Array, " joints"],
    qvel: Float[Array, " joints"],
    goals: Goals,
    max_torque: Float[Array, " joints"],
    plan: Plan,
    control_dt: float,
) -> Float[Array, " observation"]:
    """The observation of an arm, in units of the arm's own velocity limits, torques and chain length.

    - Each joint, `JOINT_FEATURES` numbers, 0 for a locked one apart from its axis and origin: whether it is free; the
      ways to the goal and to the best of the other minima, the velocity, and the velocity of the goal, by the velocity
      limit; the acceleration and the torque of the controller; the acceleration that its maximum torque gives; the
      curvature of the metric; the distances to its limits; its inertia; its axis and origin in the base frame.
    - The advantage of the best of the other minima over the goal.
    - Each link: position, direction and length. Each link of the expert at the next step: its state.

    Args:
      arm: the learner.
      expert: link states of the expert at the next step, of its own links alone.
      qpos: the learner's angles [rad].
      qvel: its velocities [rad/s].
      goals: local minima of the metric at the next step.
      max_torque: [joints] maximum torque [N m].
      plan: the controller's plan of the step.
      control_dt: duration of a control step [s].
    """
    frames = frame_table(arm, qpos, qvel)
    states = states_in_frames(arm, frames)
    dt, limit, unit = control_dt, arm.velocity_limit, 1 / arm.chain_length
    own, step = arm.is_free, control_dt * limit
    inertia = jnp.diagonal(plan.inertia)
    lower, upper = arm.angle_limits
    numbers = [
        own,
        (goals.goal.qpos - qpos) / step,
        (goals.best.qpos - qpos) / step,
        qvel / limit,
        goals.goal.qvel / limit,
        plan.acceleration * dt / limit,
        plan.torque(plan.acceleration) / jnp.maximum(max_torque, 1e-6),
        max_torque * dt / (inertia * limit),
        goals.goal.curvature * step**2,
        jnp.minimum((qpos - lower) / jnp.pi, 2.0),
        jnp.minimum((upper - qpos) / jnp.pi, 2.0),
        jnp.log(jnp.maximum(inertia, 1e-6)),
    ]
    of_joints = jnp.stack([own * x for x in numbers], axis=1)
    axes, origins = axes_and_origins(frames)
    joints = jnp.concatenate([of_joints, axes, unit * origins], axis=1)
    has_link = (arm.link_length > 0)[:, None]
    links = [has_link * x for x in (states.position, states.direction, unit * arm.link_length[:, None])]
    assert expert.direction is not None and expert.angular_velocity is not None
    of_expert = [expert.position, expert.direction, expert.linear_velocity, expert.angular_velocity]
    parts = [joints, goals.advantage[None], jnp.concatenate(links, axis=1), jnp.concatenate(of_expert, axis=1)]
    return jnp.clip(jnp.concatenate([x.ravel() for x in parts]), -_MAX_FEATURE, _MAX_FEATURE)
