"""The arm of an episode: masses, payload, friction, sensors and delays, drawn from the ranges of a world."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from mimic.arms.arm import Arm, ArmConfig, torque_scale
from mimic.arms.arrays import ArmArrays, arm_arrays, body_moments, moments_of_joints
from mimic.arms.drives import drives_of
from mimic.arms.simulation_model import joint_inertia
from mimic.control.joint_control import PERIOD
from mimic.control.limits import joint_parameters
from mimic.physics.inner_loop import Episode, JointConstants
from mimic.physics.joint_numbers import NUMBERS, joint_numbers
from mimic.physics.world import WorldConfig

GRAVITY = 9.81  # m/s^2
# Mechanical stops as critically damped springs: stiff, and slow enough for steps of 1 ms.
STOP_FREQUENCY = 100.0  # rad/s
_RANDOM_POSES = 256  # to find the largest inertia


@struct.dataclass
class Draw:
    """What is drawn for an episode.

    Attributes:
      link_mass: [joints] factor on mass and inertia of the body of each joint.
      payload: mass at the tip [kg].
      payload_lever: distance of its centre of mass from the end of the last link [m].
      gravity_error: part of the weight that is not compensated, as a fraction.
      friction: [joints] factor on the friction of each joint.
      gain: [joints] ratio of the acting to the commanded torque.
      bias: [joints] error of the measured angles [rad].
      observation_delay: age of the measurement that is observed, in ticks.
      action_delay: time from an observation until its action acts, in ticks.
    """

    link_mass: Float[Array, " joints"]
    payload: Float[Array, ""]
    payload_lever: Float[Array, ""]
    gravity_error: Float[Array, ""]
    friction: Float[Array, " joints"]
    gain: Float[Array, " joints"]
    bias: Float[Array, " joints"]
    observation_delay: Int[Array, ""]
    action_delay: Int[Array, ""]


def draw_episode(world: WorldConfig, joints: int, key: Array) -> Draw:
    """Draws an episode from the ranges of a world."""
    keys = iter(jax.random.split(key, 9))

    def drawn(name: str, bounds: Sequence[float]) -> Array:
        if name in _TICKS:
            return jax.random.randint(next(keys), (), int(bounds[0]), int(bounds[1]) + 1)
        shape = (joints,) if name in _OF_JOINTS else ()
        return jax.random.uniform(next(keys), shape, minval=bounds[0], maxval=bounds[1])

    return Draw(**{name: drawn(name, bounds) for name, bounds in _bounds(world).items()})


def drawn_fractions(draw: Draw, world: WorldConfig) -> Float[Array, " numbers"]:
    """What was drawn for an episode, each number from -1 to 1 over its range, 0 where that has no width."""
    return jnp.concatenate(
        [
            jnp.atleast_1d(2 * getattr(draw, name) - minimum - maximum) / ((maximum - minimum) or 1.0)
            for name, (minimum, maximum) in _bounds(world).items()
        ]
    )


_OF_JOINTS, _TICKS = ("link_mass", "friction", "gain", "bias"), ("observation_delay", "action_delay")


def _bounds(world: WorldConfig) -> dict[str, Sequence[float]]:
    """Minimum and maximum of each number of a `Draw`, in the order of their random keys."""
    return {
        "link_mass": world.link_mass,
        "payload": world.payload,
        "payload_lever": world.payload_lever,
        "gravity_error": world.gravity_error,
        "friction": world.friction,
        "gain": world.motor_gain,
        "bias": (-world.position_bias, world.position_bias),
        "observation_delay": world.observation_delay,
        "action_delay": world.action_delay,
    }


@dataclasses.dataclass(frozen=True)
class Plant:
    """An arm with its drives, as the inner loop simulates it.

    Attributes:
      constants: of the joints.
      numbers: [joints, numbers] `joint_numbers` without masses.
      moments: [joints + 3, joints, 7] moments of mass of each joint for a body of factor 1, and for the payload: for
        its mass, mass times lever, and mass times the square of the lever.
      upward: [3] the vertical in the frame of the first joint at angle 0.
      friction: [joints] friction torque at high speed [N m].
    """

    constants: JointConstants
    numbers: Float[np.ndarray, "joints numbers"]
    moments: Float[np.ndarray, "bodies joints moments"]
    upward: Float[np.ndarray, "3"]
    friction: Float[np.ndarray, " joints"]

    def episode(self, draw: Draw) -> Episode:
        """The arm of an episode."""
        payload, lever = draw.payload, draw.payload_lever
        factors = jnp.concatenate([draw.link_mass, jnp.stack([payload, payload * lever, payload * lever**2])])
        # Elementwise: matrix products are of lower precision on GPUs.
        moments = jnp.sum(factors[:, None, None] * jnp.asarray(self.moments, factors.dtype), axis=0)
        numbers = jnp.asarray(self.numbers, factors.dtype)
        numbers = numbers.at[:, 5:12].set(moments).at[:, 12].add(PERIOD * numbers[:, 13])
        return Episode(
            numbers=numbers.ravel(),
            base=GRAVITY * draw.gravity_error * jnp.asarray(self.upward, factors.dtype),
            gain=draw.gain,
            friction=(draw.friction * self.friction).astype(factors.dtype),
            bias=draw.bias,
        )


def make_plant(learner: ArmConfig, arm: Arm, world: WorldConfig, *, action_scale: float, control_dt: float) -> Plant:
    """The plant of an environment's learner.

    Args:
      learner: config of the arm.
      arm: the learner.
      world: the world.
      action_scale: factor on the torque range, see `EnvConfig`.
      control_dt: duration of a control step [s].

    Raises:
      ValueError: an arm that is no chain, or has too many joints or links.
    """
    arrays = arm_arrays(arm)
    drives = drives_of(learner, arm)
    inertia = joint_inertia(arm.model, np.asarray(arm.embodiment.home))
    scale = torque_scale(arm, action_scale, control_dt)
    minimum, maximum = drives.limits.position.T if world.stops else np.array([[-np.inf], [np.inf]])
    ones = np.ones(len(inertia))
    constants = JointConstants(
        parameters=joint_parameters(
            drives.limits,
            (inertia, _largest_inertia(arm, world)),
            np.asarray(arm.model.dof_damping),
            scale,
            control_dt,
        ),
        friction_rate=drives.friction.rate,
        minimum=minimum * ones,
        maximum=maximum * ones,
        stop_stiffness=inertia * STOP_FREQUENCY**2,
        stop_damping=2 * inertia * STOP_FREQUENCY,
    )
    vertical = arm.T_world_base[2, :3]  # in the base frame
    return Plant(
        constants=constants,
        numbers=np.asarray(joint_numbers(arrays), float).reshape(-1, NUMBERS)[: len(inertia)],
        moments=_moments(arm, arrays),
        upward=np.asarray(arrays.base_rotation).T @ vertical,
        friction=np.asarray(drives.friction.level, float),
    )


def _largest_inertia(arm: Arm, world: WorldConfig) -> Float[np.ndarray, " joints"]:
    """The largest `joint_inertia` of random poses with the largest payload of a world."""
    tip, along = end_of_last_link(arm)
    pose = arm.T_world_base
    point = pose[:3, :3] @ (tip + max(world.payload_lever) * along) + pose[:3, 3]
    lower, upper = np.asarray(arm.embodiment.joint_range, float).T  # a full rotation where a joint has no limits
    poses = np.random.default_rng(0).uniform(lower, upper, (_RANDOM_POSES, arm.model.nv))
    return np.max([joint_inertia(arm.model, qpos, max(world.payload), point) for qpos in poses], axis=0)


def _moments(arm: Arm, arrays: ArmArrays) -> np.ndarray:
    """See `Plant.moments`."""
    masses, rotations, origins = body_moments(arm)
    tip, along = end_of_last_link(arm)
    point = np.append(rotations[-1].T @ (tip - origins[-1]), 1.0)
    direction = np.append(rotations[-1].T @ along, 0.0)
    crossed = np.outer(point, direction)
    payloads = np.outer(point, point), crossed + crossed.T, np.outer(direction, direction)
    bodies = []
    for index in range(len(masses) + len(payloads)):
        of_body = np.zeros_like(masses)
        if index < len(masses):
            of_body[index] = masses[index]
        else:
            of_body[-1] = payloads[index - len(masses)]
        bodies.append(np.concatenate(moments_of_joints(of_body, rotations, origins), axis=1))
    return np.stack(bodies)


def end_of_last_link(arm: Arm) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """End of the last link, and its direction, in the base frame at angles 0 [m]."""
    embodiment = arm.embodiment
    direction = np.asarray(embodiment.link_rotation[-1][:, 0])
    position, length = np.asarray(embodiment.link_position[-1]), float(embodiment.link_lengths[-1])
    return position + length / 2 * direction, direction  # a link's frame is in its middle
