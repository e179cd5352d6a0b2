"""Dynamics of a chain or tree of joints on scalar components, for an arm that is constant and for an arm as data.

The composite rigid body algorithm computes the mass matrix, the recursive Newton-Euler algorithm the Coriolis and
centrifugal forces (Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapters 6 and 5). There are no contacts or
constraints. Numbers that are known while JAX traces are folded, see `mimic.base.spatial`; traced numbers make one
compiled function for all arms of as many joints.

The compile time of a GPU kernel grows with the square of the number of operations. So a transform between two frames is
two rotations in a plane, see mimic/arms/arrays.py, half as many operations as a general rotation. And the mass
distribution of a body is given by the sums of m r and m r r^T, which need fewer operations than a centre of mass and an
inertia tensor. Mass on the axis of a joint moves in the same way as part of the body that the joint moves or of its
parent. It is counted as part of the parent, for all joints up to the base. So a body has no total mass, and its moments
z and zz are zero.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.base.spatial import ZERO, Rotation, Scalar, Vector, add, cross, dot, minus, plus, rotate, times
from mimic.physics.joint_numbers import PLANE, JointNumbers, joint_numbers, unpacked

Wrench = tuple[Vector, Vector]  # force and moment
Motion = tuple[Vector, Vector, Vector]  # angular velocity and acceleration, and linear acceleration of the origin
Moments = tuple[Vector, Rotation]  # sums of m r and of m r r^T


def cosine_and_sine(angle: Scalar) -> PLANE:
    """Those of JAX's library, which have derivatives."""
    return jnp.cos(angle), jnp.sin(angle)


def acceleration(
    joints: Sequence[JointNumbers],
    qpos: Sequence[Scalar],
    qvel: Sequence[Scalar],
    torque: Sequence[Scalar],
    base: Vector | None = None,
    trigonometry: Callable[[Scalar], PLANE] = cosine_and_sine,
) -> tuple[Scalar, ...]:
    """Forward dynamics: joint accelerations [rad/s^2] under joint torques; 0 for locked joints.

    Args:
      joints: each after its parent; those of an arm as data from `with_locks`.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s]; those of locked joints are 0.
      torque: joint torques [N m].
      base: acceleration of the base, in the frame of the first joint at angle 0 [m/s^2]: minus gravity. 0 where None.
      trigonometry: cosine and sine of an angle.
    """
    turns = _turns(joints, qpos, base is None, trigonometry)
    rows = rows_of_inertia(joints, turns, inertial_wrenches(joints, turns, qvel, base=base))
    elimination = _Elimination(len(joints))
    for k, (row, bias) in zip(reversed(range(len(joints))), rows, strict=True):
        force = minus(torque[k], times(joints[k].damping, qvel[k]))
        elimination.add(k, row, joints[k].armature, minus(force, bias))
    return elimination.solution()


def with_locks(joints: Sequence[JointNumbers]) -> list[JointNumbers]:
    """The joints of an arm as data, where locked ones have an infinite armature, so that their acceleration is 0."""
    return [joint._replace(armature=jnp.where(joint.is_free > 0, joint.armature, math.inf)) for joint in joints]


def inverse(
    joints: Sequence[JointNumbers],
    qpos: Sequence[Scalar],
    qvel: Sequence[Scalar],
    qacc: Sequence[Scalar],
    base: Vector | None = None,
) -> list[Scalar]:
    """Inverse dynamics: joint torques [N m] for joint accelerations [rad/s^2]; see `acceleration` for the arguments."""
    turns = _turns(joints, qpos, base is None, cosine_and_sine)
    totals = list(inertial_wrenches(joints, turns, qvel, qacc, base))
    torque: list[Scalar] = [0.0] * len(joints)
    for i in reversed(range(len(joints))):
        joint, parent = joints[i], joints[i].parent
        of_joint = plus(times(joint.armature, qacc[i]), times(joint.damping, qvel[i]))
        torque[i] = plus(totals[i][1][2], of_joint)
        if parent >= 0:
            totals[parent] = _sum(totals[parent], wrench_to_parent(joint, turns[i], *totals[i]))
    return torque


def inertia_matrix(arm: ArmArrays, qpos: Float[Array, " joints"]) -> Float[Array, "joints joints"]:
    """Joint-space inertia with the armature [kg m^2]; locked joints have the rows of the identity."""
    return inertia_and_bias(arm, qpos, jnp.zeros_like(qpos))[0]


def inertia_and_bias(
    arm: ArmArrays, qpos: Float[Array, " joints"], qvel: Float[Array, " joints"]
) -> tuple[Float[Array, "joints joints"], Float[Array, " joints"]]:
    """`inertia_matrix`, and the joint torques [N m] for zero acceleration: Coriolis and centrifugal forces, damping."""
    joints = unpacked(joint_numbers(arm))
    turns = _turns(joints, list(qpos), True, cosine_and_sine)
    rows, torques = zip(*rows_of_inertia(joints, turns, inertial_wrenches(joints, turns, list(qvel))), strict=True)
    lower, size = rows[::-1], range(len(joints))
    matrix = jnp.stack([jnp.stack([lower[max(i, j)][min(i, j)] for j in size]) for i in size])
    both_free = arm.is_free[:, None] * arm.is_free
    matrix = both_free * matrix + jnp.diag(arm.is_free * arm.armature + (1 - arm.is_free))
    return matrix, arm.is_free * (jnp.stack(torques[::-1]) + arm.damping * qvel)


def solve(matrix: Sequence[Sequence[Scalar]], values: Sequence[Scalar], is_free: Sequence[Scalar]) -> list[Scalar]:
    """X of M x = b; only the lower triangle of M is read.

    Args:
      matrix: M, symmetric and positive definite.
      values: b.
      is_free: 1 for the rows and columns of a smaller system, 0 for those to leave out; x is 0 there.
    """
    elimination = _Elimination(len(values))
    for k in reversed(range(len(values))):
        elimination.add(k, matrix[k][: k + 1], jnp.where(is_free[k] > 0, 0.0, math.inf), values[k])
    return list(elimination.solution())


def _turns(
    joints: Sequence[JointNumbers],
    qpos: Sequence[Scalar],
    base_rests: bool,
    trigonometry: Callable[[Scalar], PLANE],
) -> list[PLANE]:
    """Cosine and sine of each joint's rotation; constants at a base at rest, where angles have no effect."""
    return [
        (1.0, 0.0) if base_rests and joint.parent < 0 else trigonometry(plus(angle, joint.reference))
        for joint, angle in zip(joints, qpos, strict=True)
    ]


def inertial_wrenches(
    joints: Sequence[JointNumbers],
    turns: Sequence[PLANE],
    qvel: Sequence[Scalar],
    qacc: Sequence[Scalar] | None = None,
    base: Vector | None = None,
) -> list[Wrench]:
    """Force and moment that accelerate each body.

    Args:
      joints: each after its parent.
      turns: cosine and sine of each joint's rotation.
      qvel: joint velocities [rad/s].
      qacc: joint accelerations [rad/s^2]; 0 where None.
      base: see `acceleration`.
    """
    at_base: Motion = (ZERO, ZERO, ZERO if base is None else base)
    motions, fields, wrenches = [], [], []
    for i, (joint, turn, speed) in enumerate(zip(joints, turns, qvel, strict=True)):
        is_first = joint.parent < 0
        parent = at_base if is_first else motions[joint.parent]
        field = (ZERO, ZERO, ZERO) if is_first else fields[joint.parent]
        omega, alpha, linear = child_motion(joint, turn, speed, parent, field)
        if qacc is not None:
            alpha = alpha[0], alpha[1], plus(alpha[2], qacc[i])
        motions.append((omega, alpha, linear))
        fields.append(acceleration_field(omega, alpha))
        wrenches.append(inertial_wrench(joint, linear, fields[i]))
    return wrenches


def rows_of_inertia(
    joints: Sequence[JointNumbers], turns: Sequence[PLANE], wrenches: Sequence[Wrench]
) -> Iterator[tuple[list[Scalar], Scalar]]:
    """Yields a row of the joint-space inertia's lower triangle and the bias torque [N m], from the last joint on.

    By the composite rigid body algorithm, without armature.

    Args:
      joints: each after its parent.
      turns: cosine and sine of each joint's rotation.
      wrenches: from `inertial_wrenches`.
    """
    distal: list[Moments] = [(ZERO, (ZERO, ZERO, ZERO))] * len(joints)  # of the bodies distal to each joint's body
    totals = list(wrenches)
    for i in reversed(range(len(joints))):
        masses = composite(joints[i], *distal[i])
        unit, j = unit_wrench(*masses), i
        row = [*[0.0] * i, unit[1][2]]
        while joints[j].parent >= 0:  # to the frames of the proximal joints
            unit, j = wrench_to_parent(joints[j], turns[j], *unit), joints[j].parent
            row[j] = unit[1][2]
        yield row, totals[i][1][2]
        parent = joints[i].parent
        if parent >= 0:
            totals[parent] = _sum(totals[parent], wrench_to_parent(joints[i], turns[i], *totals[i]))
            first, second = moments_to_parent(joints[i], turns[i], *masses)
            others, (x, y, z) = distal[parent]
            distal[parent] = add(others, first), (add(x, second[0]), add(y, second[1]), add(z, second[2]))


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


def acceleration_field(omega: Vector, alpha: Vector) -> Rotation:
    """The matrix of alpha x r + omega x (omega x r)."""
    x, y, z = omega
    xx, yy, zz = times(x, x), times(y, y), times(z, z)
    xy, yz, zx = times(x, y), times(y, z), times(z, x)
    less_xx, less_yy = times(-1.0, xx), times(-1.0, yy)
    return (
        (minus(less_yy, zz), minus(xy, alpha[2]), plus(zx, alpha[1])),
        (plus(xy, alpha[2]), minus(less_xx, zz), minus(yz, alpha[0])),
        (minus(zx, alpha[1]), plus(yz, alpha[0]), minus(less_xx, yy)),
    )


def inertial_wrench(joint: JointNumbers, linear: Vector, field: Rotation) -> Wrench:
    """Force and moment that accelerate a joint's body, without the force on its total mass.

    Args:
      joint: the joint.
      linear: acceleration of the origin of its frame [m/s^2].
      field: `acceleration_field` of the body.
    """
    xx, yy, xy, xz, yz = joint.second
    first, second = (*joint.first, 0.0), ((xx, xy, xz), (xy, yy, yz), (xz, yz, 0.0))

    def minor(i: int, j: int) -> Scalar:  # of the sum of m r x (field r)
        return minus(dot(field[j], second[i]), dot(field[i], second[j]))

    return rotate(field, first), add((minor(1, 2), minor(2, 0), minor(0, 1)), cross(first, linear))


def composite(joint: JointNumbers, first: Vector, second: Rotation) -> Moments:
    """Moments of a joint's body and of the bodies distal to it."""
    xx, yy, xy, xz, yz = joint.second
    xx, xy, xz = add((xx, xy, xz), second[0])
    yy, yz = plus(yy, second[1][1]), plus(yz, second[1][2])
    return add((*joint.first, 0.0), first), ((xx, xy, xz), (xy, yy, yz), (xz, yz, second[2][2]))


def unit_wrench(first: Vector, second: Rotation) -> Wrench:
    """Force and moment of a unit acceleration about a joint's axis, from the moments of mass that it moves."""
    moment = times(-1.0, second[0][2]), times(-1.0, second[1][2]), plus(second[0][0], second[1][1])
    return (times(-1.0, first[1]), first[0], 0.0), moment


def _sum(a: Wrench, b: Wrench) -> Wrench:
    return add(a[0], b[0]), add(a[1], b[1])


def _turned(turn: PLANE, x: Scalar, y: Scalar) -> tuple[Scalar, Scalar]:
    """A rotation in the plane of two components."""
    cosine, sine = turn
    return minus(times(cosine, x), times(sine, y)), plus(times(sine, x), times(cosine, y))


def _turned_back(turn: PLANE, x: Scalar, y: Scalar) -> tuple[Scalar, Scalar]:
    cosine, sine = turn
    return plus(times(cosine, x), times(sine, y)), minus(times(cosine, y), times(sine, x))


def to_child(joint: JointNumbers, turn: PLANE, a: Vector) -> Vector:
    """A vector of the parent frame in the joint's frame."""
    x, y = _turned_back(joint.branch, a[0], a[1])
    y, z = _turned_back(joint.twist, y, a[2])
    return *_turned_back(turn, x, y), z


def offset_in_parent(joint: JointNumbers) -> Vector:
    """Origin of the joint's frame in the parent frame [m]."""
    (a, b), (cosine, sine) = joint.offset, joint.twist
    return *_turned(joint.branch, a, times(cosine, b)), times(sine, b)


def wrench_to_parent(joint: JointNumbers, turn: PLANE, force: Vector, moment: Vector) -> Wrench:
    """A wrench of the joint's frame in the parent frame, about its origin."""
    (a, b), twist = joint.offset, joint.twist
    fx, fy = _turned(turn, force[0], force[1])
    nx, ny = _turned(turn, moment[0], moment[1])
    nx, ny = plus(nx, times(b, force[2])), minus(ny, times(a, force[2]))
    nz = plus(moment[2], minus(times(a, fy), times(b, fx)))
    (fy, fz), (ny, nz) = _turned(twist, fy, force[2]), _turned(twist, ny, nz)
    return (*_turned(joint.branch, fx, fy), fz), (*_turned(joint.branch, nx, ny), nz)


def moments_to_parent(joint: JointNumbers, turn: PLANE, first: Vector, second: Rotation) -> Moments:
    """Moments of mass of the joint's frame in the parent frame, about its origin; there is no total mass."""
    (a, b), twist, branch = joint.offset, joint.twist, joint.branch
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = second
    x, y = _turned(turn, first[0], first[1])
    z = first[2]
    xx, yy, xy = _turned_tensor(turn, xx, yy, xy)
    xz, yz = _turned(turn, xz, yz)
    xx, yy = plus(xx, times(2.0, times(a, x))), plus(yy, times(2.0, times(b, y)))
    xy = plus(xy, plus(times(a, y), times(b, x)))
    xz, yz = plus(xz, times(a, z)), plus(yz, times(b, z))
    yy, zz, yz = _turned_tensor(twist, yy, zz, yz)
    (xy, xz), (y, z) = _turned(twist, xy, xz), _turned(twist, y, z)
    xx, yy, xy = _turned_tensor(branch, xx, yy, xy)
    (xz, yz), (x, y) = _turned(branch, xz, yz), _turned(branch, x, y)
    return (x, y, z), ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))


def _turned_tensor(turn: PLANE, xx: Scalar, yy: Scalar, xy: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """A symmetric 2 x 2 matrix after a rotation in its plane: xx, yy, xy."""
    cosine, sine = turn
    if isinstance(sine, float) and sine == 0:  # by 0 or pi
        return xx, yy, xy
    if isinstance(cosine, float) and cosine == 0:  # by a quarter
        return yy, xx, times(-1.0, xy)
    difference, double = minus(yy, xx), times(2.0, xy)
    change = times(sine, minus(times(sine, difference), times(cosine, double)))
    decrease = times(sine, plus(times(sine, double), times(cosine, difference)))
    return plus(xx, change), minus(yy, change), minus(xy, decrease)


class _Elimination:
    """Solves (M + armature) x = b by elimination from the last row to the first, when these become known.

    A row with an infinite pivot has no effect on the others, and its x is 0.
    """

    def __init__(self, size: int) -> None:
        """Makes the changes of an empty system."""
        self._matrix: list[list[Scalar]] = [[0.0] * (i + 1) for i in range(size)]  # decrease of each entry
        self._values: list[Scalar] = [0.0] * size
        self._factors: list[list[Scalar]] = [[] for _ in range(size)]
        self._scaled: list[Scalar] = [0.0] * size

    def add(self, k: int, row: Sequence[Scalar], armature: Scalar, value: Scalar) -> None:
        """Eliminates x[k].

        Args:
          k: index of the row.
          row: of M, up to the diagonal.
          armature: added to the diagonal.
          value: entry of b.
        """
        row = [minus(x, change) for x, change in zip(row, self._matrix[k], strict=True)]
        value = minus(value, self._values[k])
        inverse: Any = 1.0 / plus(row[k], armature)
        self._factors[k] = [times(inverse, x) for x in row[:k]]
        self._scaled[k] = times(inverse, value)
        for i, factor in enumerate(self._factors[k]):
            self._values[i] = plus(self._values[i], times(factor, value))
            for j in range(i + 1):
                self._matrix[i][j] = plus(self._matrix[i][j], times(factor, row[j]))

    def solution(self) -> tuple[Scalar, ...]:
        """The solution x; call it after all rows."""
        solution: list[Scalar] = []
        for value, factors in zip(self._scaled, self._factors, strict=True):
            for factor, x in zip(factors, solution, strict=True):
                value = minus(value, times(factor, x))
            solution.append(value)
        return tuple(solution)
