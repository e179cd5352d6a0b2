"""What a manufacturer states about joints beyond MJCF: limits of acceleration, jerk and torque rate, friction."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mimic.arms.arm import Arm, ArmConfig, arm_spec, finite_velocity_limit
from mimic.arms.compile_check import joint_numbers
from mimic.control.limits import JointLimits, joint_limits

# Names of custom numerics with a number for each joint of a model, in the order of its joints.
ACCELERATION_LIMIT, JERK_LIMIT, TORQUE_RATE_LIMIT = "acceleration_limit", "jerk_limit", "torque_rate_limit"
FRICTION_LEVEL, FRICTION_RATE = "friction_level", "friction_rate"
# Where a model states no friction: a fifth of the viscous friction at the velocity limit, as a Panda has.
_FRICTION_FRACTION, _FRICTION_RATE = 0.2, 5.0
_UNLIMITED_TORQUE = 1e3  # N m, for joints without a torque limit
_UNLIMITED_ANGLE = 1e3  # rad, for joints whose range is a full rotation: they have no stops
_FULL_TURN = 2 * np.pi * (1 - 1e-6)


class JointFriction(NamedTuple):
    """Friction torque of each joint, level * tanh(rate * qvel), against its motion: a smooth Coulomb friction.

    Attributes:
      level: [joints] at high speed [N m].
      rate: [joints] inverse of the speed at which it saturates [s/rad].
    """

    level: Float[np.ndarray, " joints"]
    rate: Float[np.ndarray, " joints"]


class Drives(NamedTuple):
    """Limits and friction of the free joints of an arm."""

    limits: JointLimits
    friction: JointFriction


def drives_of(config: ArmConfig, arm: Arm) -> Drives:
    """The drives of an arm: what its model states in custom numerics, and assumed numbers elsewhere.

    Args:
      config: of the arm.
      arm: built from it.
    """
    model = arm_spec(config).compile()
    joints = [model.joint(name).id for name in arm.embodiment.joint_names]

    def stated(name: str) -> np.ndarray | None:
        numbers = joint_numbers(model, name)
        return np.array([numbers[joint] for joint in joints]) if set(joints) <= numbers.keys() else None

    torque = np.minimum(arm.embodiment.torque_limit, _UNLIMITED_TORQUE)
    position = np.asarray(arm.embodiment.joint_range, float)
    is_unlimited = np.ptp(position, axis=1, keepdims=True) >= _FULL_TURN
    limits = joint_limits(
        np.where(is_unlimited, _UNLIMITED_ANGLE * np.array([-1.0, 1.0]), position),
        finite_velocity_limit(arm.embodiment),
        torque,
        *(stated(name) for name in (ACCELERATION_LIMIT, JERK_LIMIT, TORQUE_RATE_LIMIT)),
    )
    level, rate = stated(FRICTION_LEVEL), stated(FRICTION_RATE)
    return Drives(
        limits,
        JointFriction(
            _FRICTION_FRACTION * np.asarray(arm.model.dof_damping) * limits.velocity if level is None else level,
            np.full(len(joints), _FRICTION_RATE) if rate is None else rate,
        ),
    )
