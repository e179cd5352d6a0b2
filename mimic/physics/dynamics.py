"""Dynamics of any arm: the equations of mimic/physics/chain_dynamics.py with the numbers of the arm as arguments.

A transform between two frames is two rotations in a plane, see mimic/arms/arrays.py, which takes half as many
operations as a general rotation. That matters twice: the compile time of a GPU kernel grows with their square.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS, ArmArrays
from mimic.base.spatial import ZERO, Rotation, Scalar, Vector, add, cross, minus, plus, rotate, times
from mimic.physics.chain_dynamics import acceleration_field, moment_of_field

PLANE = tuple[Scalar, Scalar]  # cosine and sine
Wrench = tuple[Vector, Vector]  # force and moment
Motion = tuple[Vector, Vector, Vector]  # angular velocity and acceleration, and linear acceleration of the origin


class JointNumbers(NamedTuple):
    """The numbers of a joint that its dynamics need; see `ArmArrays`."""

    twist: tuple[Scalar, Scalar]
    offset: tuple[Scalar, Scalar]
    reference: Scalar
    first: tuple[Scalar, Scalar]
    second: tuple[Scalar, Scalar, Scalar, Scalar, Scalar]
    armature: Scalar
    damping: Scalar
    is_free: Scalar


NUMBERS = 15  # of a joint


def joint_numbers(arm: ArmArrays) -> Float[Array, " numbers"]:
    """The numbers of all joints as one vector, for `unpacked`."""
    # The diagonal entry of a locked joint has no effect, but forward dynamics divide by it: 1 keeps it away from 0.
    armature = arm.armature + (1 - arm.is_free)
    columns = [arm.twist, arm.offset, arm.reference[:, None], arm.first_moment, arm.second_moment]
    columns += [armature[:, None], arm.damping[:, None], arm.is_free[:, None]]
    return jnp.concatenate(columns, axis=1).ravel()


def unpacked(numbers: Any) -> list[JointNumbers]:
    """The numbers of each joint, from the vector of `joint_numbers`."""
    return [joint_of([numbers[NUMBERS * i + k] for k in range(NUMBERS)]) for i in range(MAX_JOINTS)]


def joint_of(numbers: Any) -> JointNumbers:
    """The numbers of one joint, from its part of the vector of `joint_numbers`."""
    x = numbers
    first, second = (x[5], x[6]), (x[7], x[8], x[9], x[10], x[11])
    return JointNumbers((x[0], x[1]), (x[2], x[3]), x[4], first, second, x[12], x[13], x[14])


def inertia_matrix(arm: ArmArrays, qpos: Float[Array, " joints"]) -> Float[Array, "joints joints"]:
    """Joint-space inertia with the armature [kg m^2]; locked joints have the rows of the identity."""
    joints = unpacked(joint_numbers(arm))
    at_rest = [(ZERO, ZERO)] * len(joints)
    return _full_inertia(arm, [row for row, _ in rows_of_inertia(joints, _turns(joints, list(qpos)), at_rest)])


def inertia_and_bias(
    arm: ArmArrays, qpos: Float[Array, " joints"], qvel: Float[Array, " joints"]
) -> tuple[Float[Array, "joints joints"], Float[Array, " joints"]]:
    """`inertia_matrix`, and the joint torques [N m] for zero acceleration: Coriolis and centrifugal forces, damping."""
    joints = unpacked(joint_numbers(arm))
    turns = _turns(joints, list(qpos))
    rows, torques = zip(*rows_of_inertia(joints, turns, inertial_wrenches(joints, turns, list(qvel))), strict=True)
    bias = jnp.stack(torques[::-1])
    return _full_inertia(arm, rows), arm.is_free * (bias + arm.damping * qvel)


def _full_inertia(arm: ArmArrays, last_first: Sequence[Sequence[Scalar]]) -> Float[Array, "joints joints"]:
    lower = last_first[::-1]
    rows = [jnp.stack([lower[max(i, j)][min(i, j)] for j in range(MAX_JOINTS)]) for i in range(MAX_JOINTS)]
    both_free = arm.is_free[:, None] * arm.is_free
    return both_free * jnp.stack(rows) + jnp.diag(arm.is_free * arm.armature + (1 - arm.is_free))


def _turns(joints: Sequence[JointNumbers], qpos: Sequence[Scalar]) -> list[PLANE]:
    """Cosine and sine of the rotation of each joint about its axis."""
    angles = [plus(angle, joint.reference) for joint, angle in zip(joints, qpos, strict=True)]
    return [(jnp.cos(angle), jnp.sin(angle)) for angle in angles]


def inertial_wrenches(
    joints: Sequence[JointNumbers], turns: Sequence[PLANE], qvel: Sequence[Scalar], base: Vector | None = None
) -> list[Wrench]:
    """Force and moment that accelerate each body at zero joint acceleration.

    Args:
      joints: from `unpacked`.
      turns: cosine and sine of each joint's rotation.
      qvel: joint velocities [rad/s].
      base: acceleration of the base, in the frame of the first joint at angle 0 [m/s^2]; 0 where None.
    """
    motion: Motion = (ZERO, ZERO, ZERO if base is None else base)
    field = ZERO, ZERO, ZERO
    wrenches = []
    for joint, turn, speed in zip(joints, turns, qvel, strict=True):
        motion = child_motion(joint, turn, speed, motion, field)
        field = acceleration_field(motion[0], motion[1])
        wrenches.append(inertial_wrench(joint, motion[2], field))
    return wrenches


def rows_of_inertia(
    joints: Sequence[JointNumbers], turns: Sequence[PLANE], wrenches: Sequence[Wrench]
) -> Iterator[tuple[list[Scalar], Scalar]]:
    """Yields a row of the joint-space inertia's lower triangle and the bias torque [N m], from the last joint on.

    By the composite rigid body algorithm, without armature.

    Args:
      joints: from `unpacked`.
      turns: cosine and sine of each joint's rotation.
      wrenches: from `inertial_wrenches`.
    """
    masses: Any = (ZERO, (ZERO, ZERO, ZERO))
    total = ZERO, ZERO  # wrench of the distal bodies
    for i in reversed(range(len(joints))):
        masses = composite(joints[i], *masses)
        unit = unit_wrench(*masses)
        total = add(total[0], wrenches[i][0]), add(total[1], wrenches[i][1])
        row, bias = [unit[1][2]], total[1][2]
        for j in reversed(range(1, i + 1)):  # to the frames of the joints before it
            unit = wrench_to_parent(joints[j], turns[j], *unit)
            row.insert(0, unit[1][2])
        yield row, bias
        if i > 0:
            total = wrench_to_parent(joints[i], turns[i], *total)
            masses = moments_to_parent(joints[i], turns[i], *masses)


def child_motion(joint: JointNumbers, turn: PLANE, speed: Scalar, parent: Motion, field: Rotation) -> Motion:
    """Motion of a joint's body at zero joint acceleration.

    Args:
      joint: the joint.
      turn: cosine and sine of its rotation.
      speed: its velocity [rad/s].
      parent: motion of the parent body, in that body's frame.
      field: `acceleration_field` of the parent body: the acceleration of its point r is linear + field r.
    """
    omega, alpha, linear = parent
    linear = to_child(joint, turn, add(linear, rotate(field, offset_in_parent(joint))))
    omega, alpha = to_child(joint, turn, omega), to_child(joint, turn, alpha)
    alpha = plus(alpha[0], times(omega[1], speed)), minus(alpha[1], times(omega[0], speed)), alpha[2]
    return (omega[0], omega[1], plus(omega[2], speed)), alpha, linear


def inertial_wrench(joint: JointNumbers, linear: Vector, field: Rotation) -> tuple[Vector, Vector]:
    """Force and moment that accelerate a joint's body, without the force on its total mass, see `Inertia`.

    Args:
      joint: the joint.
      linear: acceleration of the origin of its frame [m/s^2].
      field: `acceleration_field` of the body.
    """
    first, second = (*joint.first, 0.0), symmetric(joint.second)
    return rotate(field, first), add(moment_of_field(field, second), cross(first, linear))


def composite(joint: JointNumbers, first: Vector, second: Rotation) -> tuple[Vector, Rotation]:
    """Moments of a joint's body and of the bodies after it."""
    xx, yy, xy, xz, yz = joint.second
    xx, xy, xz = add((xx, xy, xz), second[0])
    yy, yz = plus(yy, second[1][1]), plus(yz, second[1][2])
    return add((*joint.first, 0.0), first), ((xx, xy, xz), (xy, yy, yz), (xz, yz, second[2][2]))


def unit_wrench(first: Vector, second: Rotation) -> tuple[Vector, Vector]:
    """Force and moment of a unit acceleration about a joint's axis, from the moments of mass that it moves."""
    moment = times(-1.0, second[0][2]), times(-1.0, second[1][2]), plus(second[0][0], second[1][1])
    return (times(-1.0, first[1]), first[0], 0.0), moment


def symmetric(second: tuple[Scalar, Scalar, Scalar, Scalar, Scalar]) -> Rotation:
    """Rows of the second moment, whose zz is 0."""
    xx, yy, xy, xz, yz = second
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, 0.0)


def turned(turn: PLANE, x: Scalar, y: Scalar) -> tuple[Scalar, Scalar]:
    """A rotation in the plane of two components."""
    cosine, sine = turn
    return minus(times(cosine, x), times(sine, y)), plus(times(sine, x), times(cosine, y))


def _turned_back(turn: PLANE, x: Scalar, y: Scalar) -> tuple[Scalar, Scalar]:
    cosine, sine = turn
    return plus(times(cosine, x), times(sine, y)), minus(times(cosine, y), times(sine, x))


def to_child(joint: JointNumbers, turn: PLANE, a: Vector) -> Vector:
    """A vector of the parent frame in the joint's frame."""
    y, z = _turned_back(joint.twist, a[1], a[2])
    x, y = _turned_back(turn, a[0], y)
    return x, y, z


def offset_in_parent(joint: JointNumbers) -> Vector:
    """Origin of the joint's frame in the parent frame [m]."""
    (a, b), (cosine, sine) = joint.offset, joint.twist
    return a, times(cosine, b), times(sine, b)


def wrench_to_parent(joint: JointNumbers, turn: PLANE, force: Vector, moment: Vector) -> tuple[Vector, Vector]:
    """A wrench of the joint's frame in the parent frame, about its origin."""
    (a, b), twist = joint.offset, joint.twist
    fx, fy = turned(turn, force[0], force[1])
    nx, ny = turned(turn, moment[0], moment[1])
    nx, ny = plus(nx, times(b, force[2])), minus(ny, times(a, force[2]))
    nz = plus(moment[2], minus(times(a, fy), times(b, fx)))
    return (fx, *turned(twist, fy, force[2])), (nx, *turned(twist, ny, nz))


def moments_to_parent(joint: JointNumbers, turn: PLANE, first: Vector, second: Rotation) -> tuple[Vector, Rotation]:
    """Moments of mass of the joint's frame in the parent frame, about its origin; there is no total mass."""
    (a, b), twist = joint.offset, joint.twist
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = second
    x, y = turned(turn, first[0], first[1])
    z = first[2]
    xx, yy, xy = turned_tensor(turn, xx, yy, xy)
    xz, yz = turned(turn, xz, yz)
    xx, yy = plus(xx, times(2.0, times(a, x))), plus(yy, times(2.0, times(b, y)))
    xy = plus(xy, plus(times(a, y), times(b, x)))
    xz, yz = plus(xz, times(a, z)), plus(yz, times(b, z))
    yy, zz, yz = turned_tensor(twist, yy, zz, yz)
    xy, xz = turned(twist, xy, xz)
    return (x, *turned(twist, y, z)), ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))


def turned_tensor(turn: PLANE, xx: Scalar, yy: Scalar, xy: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """A symmetric 2 x 2 matrix after a rotation in its plane: xx, yy, xy."""
    cosine, sine = turn
    difference, double = minus(yy, xx), times(2.0, xy)
    change = times(sine, minus(times(sine, difference), times(cosine, double)))
    decrease = times(sine, plus(times(sine, double), times(cosine, difference)))
    return plus(xx, change), minus(yy, change), minus(xy, decrease)


def torque_of_arm(
    arm: ArmArrays,
    qpos: Float[Array, " joints"],
    qvel: Float[Array, " joints"],
    qacc: Float[Array, " joints"],
) -> Float[Array, " joints"]:
    """Inverse dynamics: joint torques [N m] for joint accelerations [rad/s^2]; 0 for locked joints."""
    inertia, bias = inertia_and_bias(arm, qpos, qvel)
    return arm.is_free * jnp.sum(inertia * (arm.is_free * qacc), axis=1) + bias
