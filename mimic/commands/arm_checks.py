"""What can be told of a pair of arms before anything is trained: figures that cost seconds."""

import copy
import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from mimic.arms.arm import UNKNOWN_SPEED, Arm, ArmConfig, arm_spec, torque_scale, with_minimum_armature
from mimic.arms.embodiment import load_arm
from mimic.envs.config import EnvConfig
from mimic.envs.recording import record_demonstrations
from mimic.metric.kinematics import link_state_table
from mimic.retargeting.kinematic_bound import closest_motion

_DEMONSTRATIONS, _EVERY = 2, 5  # few, and of them every fifth step: a rough value in seconds

# Rotor inertias [kg m^2] that are tried in turn where an arm runs away; the Panda's joints have 0.1. Damping is in
# proportion, as there: [1/s].
_ARMATURES, _DAMPING_SHARE = (0.01, 0.03, 0.1, 0.3), 10.0
_CERTAIN = 10.0  # times the speed bound: a runaway
_CALM_SHARE = 0.8  # of the speed bound that random torques may reach


@dataclasses.dataclass(frozen=True)
class ReachableDistance:
    """How near a learner can come to some demonstrations of its expert, mean over their steps.

    Attributes:
      bound: embodiment distance that no controller can go below.
      hold: distance of the learner at rest in its home pose.
      expert_qpos: [poses, 1, joints] the expert's poses that were looked at [rad].
      nearest_qpos: [poses, 1, learner_joints] the learner's nearest poses [rad].
    """

    bound: float
    hold: float
    expert_qpos: Float[np.ndarray, "poses 1 joints"]
    nearest_qpos: Float[np.ndarray, "poses 1 learner_joints"]


def reachable_distance(expert: Arm, learner: Arm, config: EnvConfig) -> ReachableDistance:
    """Kinematic bound and holding still, on a few random demonstrations.

    Raises:
      ValueError: the expert's limits leave it no goal.
    """
    recorded = record_demonstrations(expert, _DEMONSTRATIONS, horizon=config.horizon, dt=config.control_dt)
    pair = expert.embodiment, learner.embodiment
    metric = config.metric.build(*pair)
    qpos, qvel = (
        x[:, 1::_EVERY].reshape(-1, expert.embodiment.num_joints).astype(np.float32)
        for x in (recorded.qpos, recorded.qvel)
    )

    home = np.broadcast_to(np.asarray(learner.embodiment.home), (len(qpos), learner.embodiment.num_joints))
    still = link_state_table(learner.embodiment, home, np.zeros_like(home))
    hold = jax.jit(jax.vmap(metric))(link_state_table(expert.embodiment, qpos, qvel), still)
    found = jax.jit(lambda qpos, qvel: closest_motion(*pair, qpos, qvel, **metric.arguments))(qpos, qvel)
    return ReachableDistance(
        float(jnp.mean(found.distance)), float(jnp.mean(hold)), qpos[:, None], np.asarray(found.qpos)[:, None]
    )


def random_torque_speed(arm: Arm, config: EnvConfig) -> float:
    """Largest joint speed [rad/s] in an episode of random torques, as an untrained policy makes them; inf beyond all.

    Stops where it is certain that an episode would have ended.
    """
    model = copy.copy(arm.model)
    model.opt.timestep = config.control_dt / config.substeps
    data = mujoco.MjData(model)
    data.qpos[:] = arm.embodiment.home
    scale, rng, largest = torque_scale(arm, config.action_scale, config.control_dt), np.random.default_rng(0), 0.0
    for _ in range(config.horizon):
        data.qfrc_applied[:] = scale * rng.uniform(-1, 1, model.nv)
        for _ in range(config.substeps):  # not mj_step, which logs to a file what diverges
            mujoco.mj_forward(model, data)
            mujoco.mj_RungeKutta(model, data, 4)
            speed = float(np.abs(data.qvel).max())
            if not speed < _CERTAIN * config.speed_bound:  # also where not a number
                return speed if np.isfinite(speed) else np.inf
            largest = max(largest, speed)
    return largest


def joint_ranges(config: ArmConfig, arm: Arm) -> Float[np.ndarray, "joints 2"]:
    """Ranges [rad] of an arm's free joints as its model states them, -pi to pi where it states none."""
    if not config.is_file:
        return np.asarray(arm.embodiment.joint_range)
    whole = load_arm(config.model, base=config.base, tip=config.tip)[0]
    return np.asarray(whole.joint_range)[[whole.joint_names.index(name) for name in arm.embodiment.joint_names]]


def assumptions(config: ArmConfig, arm: Arm) -> Iterator[str]:
    """What the model of an arm does not say, and what is taken instead."""
    embodiment, names = arm.embodiment, np.array(arm.embodiment.joint_names)
    without = names[~np.isfinite(embodiment.velocity_limit)]
    if without.size:
        yield (
            f"no rated speed for {_listed(without)}: {UNKNOWN_SPEED:.2f} rad/s is assumed; a custom numeric "
            "velocity_limit in the MJCF, one number for each joint, states it"
        )
    without = names[~np.isfinite(embodiment.torque_limit)]
    if without.size:
        yield (
            f"no torque limit for {_listed(without)}: what takes the joint from rest to twice its rated speed in one "
            "control step is assumed"
        )
    if config.is_file:
        spec = arm_spec(config)
        moving = {joint.name: joint.parent for joint in spec.joints}
        guessed = [moving[name].name for name in names if not moving[name].explicitinertial]
        if guessed:
            yield (
                f"no <inertial> in {_listed(guessed)}: inertia from the geoms, at the density of water where they "
                "state neither mass nor density"
            )


def warnings(config: ArmConfig, arm: Arm) -> Iterator[str]:
    """What may keep a learner from imitating well."""
    embodiment, names = arm.embodiment, np.array(arm.embodiment.joint_names)
    unseen = names[max(embodiment.link_joint) + 1 :]
    if unseen.size:
        yield f"{_listed(unseen)}: moves no link, so that nothing is seen of it; a tip farther out would show it"
    shared = [name for index, name in enumerate(names) if index not in embodiment.link_joint and name not in unseen]
    if shared:
        yield f"{_listed(shared)}: on one spot with the next joint, so that their links count as one"
    lower, upper = joint_ranges(config, arm).T
    outside = names[(embodiment.home < lower) | (embodiment.home > upper)]
    if outside.size:
        yield f"{_listed(outside)}: the start pose is outside of the joint range; limits=hardware starts within"


def calmed(config: ArmConfig, arm: Arm, env: EnvConfig) -> tuple[ArmConfig, str]:
    """The arm with rotor inertia and damping where it needs some not to run away, and why; "" where it needs none.

    Few models state the rotor inertia of their motors, without which random torques whirl the light wrists about, and
    an episode ends before anything is learned.
    """
    speed = alone = random_torque_speed(arm, env)
    limit, tried = _CALM_SHARE * env.speed_bound, config
    for armature in _ARMATURES:
        if speed < limit:
            break
        tried = dataclasses.replace(config, armature=armature, damping=_DAMPING_SHARE * armature)
        speed = random_torque_speed(with_minimum_armature(arm, tried), env)
    if alone < limit:
        return config, ""
    return tried, (
        f"random torques take a joint to {alone:.3g} rad/s and more, where episodes end at {env.speed_bound:g} rad/s; "
        f"with a rotor inertia of {tried.armature:g} kg m^2 and a damping of {tried.damping:g} N m s/rad in each "
        f"joint, as in the command below, to {speed:.3g} rad/s"
    )


def _listed(names: np.ndarray | list[str]) -> str:
    return ", ".join(map(str, names))
