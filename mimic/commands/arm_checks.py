"""Checks of a pair of arms before training, each of which takes seconds."""

import copy
import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import (
    DEFAULT_VELOCITY_LIMIT,
    Arm,
    ArmConfig,
    arm_spec,
    finite_velocity_limit,
    torque_scale,
    with_minimum_armature,
)
from mimic.arms.embodiment import load_arm
from mimic.arms.simulation_model import effective_inertia
from mimic.envs.config import EnvConfig
from mimic.metric.kinematics import link_state_table
from mimic.motions.demonstrations import Demonstrations
from mimic.motions.recording import record_demonstrations
from mimic.retargeting.kinematic_bound import closest_motion

_DEMONSTRATIONS, _EVERY = 2, 5  # two demonstrations, every fifth step: a rough estimate within seconds

# Rotor inertias [kg m^2] tried in turn for a joint that exceeds the velocity bound; the Panda's joints have 0.1.
# The damping is proportional, with the ratio of the Panda [1/s].
_ARMATURES, _DAMPING_RATIO = (0.01, 0.03, 0.1, 0.3), 10.0
_TORQUE_FRACTION = 0.5  # of a joint's torque limit, at most, that the first damping takes at its velocity limit
_DIVERGED = 10.0  # multiple of the velocity bound at which a simulation stops early
_SLOWEST = 1.0  # s from rest to the velocity limit; the Panda's joints take up to 0.03, those of a UR5e 0.2
_SAFE_FRACTION = 0.8  # of the velocity bound, that random torques may reach


@dataclasses.dataclass(frozen=True)
class ReachableDistance:
    """Distance that a learner can reach on a few demonstrations of its expert, mean over their steps.

    Attributes:
      bound: kinematic bound: no controller reaches a smaller embodiment distance.
      hold: embodiment distance of holding the start pose.
      expert_qpos: poses of the expert in these steps [rad].
      nearest_qpos: nearest poses of the learner [rad].
    """

    bound: float
    hold: float
    expert_qpos: Float[np.ndarray, "poses 1 joints"]
    nearest_qpos: Float[np.ndarray, "poses 1 learner_joints"]


def sample_demonstrations(expert: Arm, config: EnvConfig) -> Demonstrations:
    """Records the demonstrations that `reachable_distance` is computed on.

    Raises:
      ValueError: the expert's limits permit no goal.
    """
    return record_demonstrations(expert, _DEMONSTRATIONS, horizon=config.horizon, dt=config.control_dt)


def reachable_distance(
    expert: Arm, learner: Arm, config: EnvConfig, demonstrations: Demonstrations
) -> ReachableDistance:
    """Computes the kinematic bound and the distance of holding the start pose on demonstrations."""
    pair = expert.embodiment, learner.embodiment
    metric = config.metric.build(*pair)
    qpos, qvel = (
        x[:, 1::_EVERY].reshape(-1, expert.embodiment.num_joints).astype(np.float32)
        for x in (demonstrations.qpos, demonstrations.qvel)
    )

    home = np.broadcast_to(np.asarray(learner.embodiment.home), (len(qpos), learner.embodiment.num_joints))
    at_rest = link_state_table(learner.embodiment, home, np.zeros_like(home))
    hold = jax.jit(jax.vmap(metric))(link_state_table(expert.embodiment, qpos, qvel), at_rest)
    closest = jax.jit(lambda qpos, qvel: closest_motion(*pair, qpos, qvel, **metric.arguments))(qpos, qvel)
    return ReachableDistance(
        float(jnp.mean(closest.distance)), float(jnp.mean(hold)), qpos[:, None], np.asarray(closest.qpos)[:, None]
    )


def random_torque_speeds(arm: Arm, config: EnvConfig) -> Float[np.ndarray, " joints"]:
    """Maximum velocity of each joint [rad/s] in an episode of random torques, such as those of an untrained policy.

    The simulation stops early once a velocity is far above the bound that ends an episode; inf for joints that diverge.
    """
    model = copy.copy(arm.model)
    model.opt.timestep = config.control_dt / config.substeps
    data = mujoco.MjData(model)
    data.qpos[:] = arm.embodiment.home
    scale, rng = torque_scale(arm, config.action_scale, config.control_dt), np.random.default_rng(0)
    maximum = np.zeros(model.nv)
    for _ in range(config.horizon):
        data.qfrc_applied[:] = scale * rng.uniform(-1, 1, model.nv)
        for _ in range(config.substeps):  # not mj_step, which writes a log file on divergence
            mujoco.mj_forward(model, data)
            mujoco.mj_RungeKutta(model, data, 4)
            speed = np.nan_to_num(np.abs(data.qvel), nan=np.inf)
            maximum = np.maximum(maximum, speed)
            if not speed.max() < _DIVERGED * config.speed_bound:
                return maximum
    return maximum


def joint_ranges(config: ArmConfig, arm: Arm) -> Float[np.ndarray, "joints 2"]:
    """Ranges [rad] of an arm's free joints in its model; -pi to pi where the model has none."""
    if not config.is_file:
        return np.asarray(arm.embodiment.joint_range)
    unlocked = load_arm(config.model, base=config.base, tip=config.tip)[0]
    return np.asarray(unlocked.joint_range)[[unlocked.joint_names.index(name) for name in arm.embodiment.joint_names]]


def assumptions(config: ArmConfig, arm: Arm) -> Iterator[str]:
    """Yields what the model of an arm leaves out, and the value that is assumed instead."""
    embodiment, names = arm.embodiment, np.array(arm.embodiment.joint_names)
    unlimited = names[~np.isfinite(embodiment.velocity_limit)]
    if unlimited.size:
        yield (
            f"no velocity limit for {_listed(unlimited)}: {DEFAULT_VELOCITY_LIMIT:.2f} rad/s is assumed; a URDF can "
            "set it as <limit velocity>, an MJCF as a custom numeric velocity_limit with one number for each joint"
        )
    unlimited = names[~np.isfinite(embodiment.torque_limit)]
    if unlimited.size:
        yield (
            f"no torque limit for {_listed(unlimited)}: the torque is assumed that accelerates the joint from rest to "
            "twice its velocity limit in one control step"
        )
    if config.is_file:
        spec = arm_spec(config)
        bodies = {joint.name: joint.parent for joint in spec.joints}
        estimated = [bodies[name].name for name in names if not bodies[name].explicitinertial]
        if estimated:
            yield (
                f"no <inertial> in {_listed(estimated)}: inertia is computed from the geoms, with the density of water "
                "where they have neither mass nor density"
            )


def warnings(config: ArmConfig, arm: Arm) -> Iterator[str]:
    """Yields reasons why a learner may imitate badly."""
    embodiment, names = arm.embodiment, np.array(arm.embodiment.joint_names)
    without_link = names[max(embodiment.link_joint) + 1 :]
    if without_link.size:
        seen = "sees it by the hand alone" if embodiment.hand_joint else "ignores it"
        yield f"{_listed(without_link)}: moves no link, so the metric {seen}; a more distal tip would include it"
    coincident = [
        name for index, name in enumerate(names) if index not in embodiment.link_joint and name not in without_link
    ]
    if coincident:
        yield f"{_listed(coincident)}: at the same point as the next joint, so that their links count as one"
    lower, upper = joint_ranges(config, arm).T
    outside = names[(embodiment.home < lower) | (embodiment.home > upper)]
    if outside.size:
        yield f"{_listed(outside)}: the start pose is outside the joint range; limits=hardware starts inside it"
    seconds = finite_velocity_limit(embodiment) * effective_inertia(arm.model, np.asarray(embodiment.home))
    seconds /= np.asarray(embodiment.torque_limit)
    weak = names[seconds > _SLOWEST]
    if weak.size:
        yield (
            f"{_listed(weak)}: at the torque limit it takes {seconds.max():.3g} s to reach the velocity limit, too "
            "long to imitate a motion; are masses in kg and torques in N m?"
        )
    yield from hand_doubts("learner", arm)


def hand_doubts(role: str, arm: Arm) -> Iterator[str]:
    """Yields what speaks against the hand frames of an arm; `role` is that of its keys."""
    yield from (f"the hand of {arm.embodiment.name}: {x.doubt}; {role}.hand= sets it" for x in arm.ends if x.doubt)


def stabilised(config: ArmConfig, arm: Arm, env: EnvConfig) -> tuple[ArmConfig, str]:
    """Adds rotor inertia and damping to the joints that exceed the velocity bound under random torques.

    Few models have the rotor inertia of their motors. Without it, random torques spin light wrist links up, and an
    episode ends before anything is learned. Joints that are slow enough stay as they are.

    Returns:
      The config of the arm, and the reason for the change; "" where none is needed.
    """
    speeds = random_torque_speeds(arm, env)
    limit, names = _SAFE_FRACTION * env.speed_bound, arm.embodiment.joint_names
    original, changed, levels = speeds.max(), config, np.zeros(len(names), int)
    damping_torque = _DAMPING_RATIO * _ARMATURES[0] * finite_velocity_limit(arm.embodiment)
    strength = np.minimum(1.0, _TORQUE_FRACTION * np.asarray(arm.embodiment.torque_limit) / damping_torque)
    armature: dict[str, float] = {}
    while (raised := (speeds >= limit) & (levels < len(_ARMATURES))).any():
        levels += raised
        armature = {
            name: float(f"{_ARMATURES[level - 1] * factor:.2g}")
            for name, level, factor in zip(names, levels.tolist(), strength.tolist(), strict=True)
            if level
        }
        changed = _with_armature(config, arm, armature)
        speeds = random_torque_speeds(with_minimum_armature(arm, changed), env)
    if original < limit:
        return config, ""
    values = ", ".join(f"{value:g} in {name}" for name, value in armature.items())
    return changed, (
        f"random torques accelerate a joint to {original:.3g} rad/s or more, but episodes end at "
        f"{env.speed_bound:g} rad/s; a rotor inertia [kg m^2] of {values}, and {_DAMPING_RATIO:g} times that as "
        f"damping [N m s/rad], as in the command below, reduce this to {speeds.max():.3g} rad/s"
    )


def _with_armature(config: ArmConfig, arm: Arm, armature: Mapping[str, float]) -> ArmConfig:
    """The config with the rotor inertia of some joints and its damping; what it states already is the minimum."""
    damping = {name: _DAMPING_RATIO * value for name, value in armature.items()}
    changes: dict[str, Any] = {}
    for key, proposed in (("armature", armature), ("damping", damping)):
        stated = getattr(config, key)
        names = arm.embodiment.joint_names
        before: Mapping[str, float] = stated if isinstance(stated, Mapping) else {name: stated for name in names}
        values = {name: round(max(before.get(name, 0.0), proposed.get(name, 0.0)), 6) for name in (*before, *proposed)}
        changes[key] = {name: value for name, value in values.items() if value}
    return dataclasses.replace(config, **changes)


def _listed(names: np.ndarray | list[str]) -> str:
    return ", ".join(map(str, names))
