"""Forward dynamics of any arm as loops over the joints, on arrays with the batch as their last axis, for CPUs.

XLA's CPU backend compiles the loops five times as fast as the unrolled equations of mimic/physics/dynamics.py, and
they run twice as fast there: an operation is a loop over adjacent samples, and XLA repeats less computation in the
results of a loop's short body. Ten steps of 512 Pandas on two cores: 0.6 s and 30 ms, against 3.0 s and 59 ms.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.base.spatial import add, vector
from mimic.physics import dynamics
from mimic.physics.joint_numbers import joint_of

Joints = Float[Array, "joints *batch"]
_Turns = tuple[Joints, Joints]  # cosine and sine of the rotation of each joint


def acceleration(
    numbers: Float[Array, "joints numbers *batch"],
    qpos: Joints,
    qvel: Joints,
    torque: Joints,
    base: Any = None,
) -> Joints:
    """Forward dynamics: joint accelerations [rad/s^2] under joint torques; 0 for locked joints.

    Args:
      numbers: from `joint_numbers`, a row for each joint.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s].
      torque: joint torques [N m].
      base: three components of the base's acceleration, see mimic/physics/dynamics.py; 0 where None.
    """
    joints = joint_of(jnp.moveaxis(numbers, 1, 0))
    angles = qpos + joints.reference
    turns = jnp.cos(angles), jnp.sin(angles)
    matrix, bias = _mass_matrix_and_bias(numbers, turns, _wrenches(numbers, turns, qvel, base))
    return _solve(matrix, joints.armature, torque - joints.damping * qvel - bias, joints.is_free)


def _wrenches(numbers: Array, turns: _Turns, qvel: Joints, base: Any) -> Any:
    """Force and moment that accelerate each body at zero joint acceleration: vectors of [joints, *batch]."""

    def outward(parent: Any, joint: Any) -> Any:
        row, turn, speed = joint
        field = dynamics.acceleration_field(parent[0], parent[1])
        motion = dynamics.child_motion(joint_of(row), turn, speed, parent, field)
        return motion, motion

    zero = jnp.zeros_like(qvel[0])
    zeros = (zero,) * 3
    start = zeros, zeros, zeros if base is None else tuple(zero + x for x in base)
    _, (omega, alpha, linear) = jax.lax.scan(outward, start, (numbers, turns, qvel))
    joints = joint_of(jnp.moveaxis(numbers, 1, 0))
    return dynamics.inertial_wrench(joints, linear, dynamics.acceleration_field(omega, alpha))


def _mass_matrix_and_bias(
    numbers: Array, turns: _Turns, wrenches: Any
) -> tuple[Float[Array, "joints joints *batch"], Joints]:
    """The inertia M without armature, as M[k, i] in entry [i, k >= i], and the Coriolis and centrifugal torques."""
    zero = jnp.zeros_like(turns[0][0])
    joints = len(numbers)
    is_own = jnp.eye(joints, dtype=bool).reshape(joints, joints, *[1] * zero.ndim)

    def inward(carry: Any, joint: Any) -> Any:
        # Wrenches [joints, *batch] of unit accelerations about the distal joints, and the wrench of the bias forces.
        (force, moment), bias, distal_masses = carry
        row, turn, wrench, is_own = joint
        numbers_of_joint = joint_of(row)
        masses = first, second = dynamics.composite(numbers_of_joint, *distal_masses)
        own_force, own_moment = dynamics.unit_wrench(first, second)
        force = vector([jnp.where(is_own, x, y) for x, y in zip(own_force, force, strict=True)])
        moment = vector([jnp.where(is_own, x, y) for x, y in zip(own_moment, moment, strict=True)])
        bias = add(bias[0], wrench[0]), add(bias[1], wrench[1])
        result = moment[2], bias[1][2]
        units = dynamics.wrench_to_parent(numbers_of_joint, turn, force, moment)
        bias = dynamics.wrench_to_parent(numbers_of_joint, turn, *bias)
        return (units, bias, dynamics.moments_to_parent(numbers_of_joint, turn, *masses)), result

    zeros, zero_vector = (jnp.zeros_like(turns[0]),) * 3, (zero,) * 3
    start = (zeros, zeros), (zero_vector, zero_vector), (zero_vector, (zero_vector,) * 3)
    return jax.lax.scan(inward, start, (numbers, turns, wrenches, is_own), reverse=True)[1]


def _solve(matrix: Float[Array, "joints joints *batch"], armature: Joints, values: Joints, is_free: Joints) -> Joints:
    """X of (M + armature) x = b by elimination from the last joint to the first; 0 for locked joints."""
    indices = jnp.arange(len(armature))
    matrix = matrix.at[indices, indices].add(armature)
    scaled, factors = [], []  # pivots are divided by once, and locked joints have a factor of 0
    for k in reversed(range(len(armature))):
        inverse, column = is_free[k] / matrix[k, k], matrix[:k, k]
        factors.insert(0, inverse * column)
        scaled.insert(0, inverse * values[k])
        values = values[:k] - factors[0] * values[k]
        matrix = matrix[:k, :k] - factors[0][:, None] * column
    solution: list[Array] = []
    for k in range(len(armature)):
        value = scaled[k]
        for i in range(k):
            value = value - factors[k][i] * solution[i]
        solution.append(value)
    return jnp.stack(solution)
