"""Steps of any arm in one GPU kernel: the articulated body algorithm as loops over the joints.

The algorithm is that of Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapter 7. Frames and moments of mass are
those of mimic/any_arm/arrays.py: a transform between two frames is two rotations in a plane, and bodies have no total
mass.

The compile time of a GPU kernel grows with the square of the number of operations of a basic block. The equations of
mimic/envs/dynamics.py with the arm's numbers as inputs are one block: 47.5 s on an H200. Loops take 3.7 s and have 40 %
of the speed, which is still far above what a training needs.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mimic.any_arm import dynamics
from mimic.any_arm.arrays import MAX_JOINTS
from mimic.any_arm.dynamics import PLANE, JointNumbers, Motion, turned, turned_tensor
from mimic.envs.dynamics import acceleration_field
from mimic.envs.physics import runge_kutta
from mimic.metric import fused_kernel
from mimic.metric.spatial import Scalar, Vector, add, cross, dot, minus, plus, rotate, scale, subtract, times

# Measured on an H200. Samples are the last axis: a thread reads the numbers of a joint when it comes to the joint, and
# rows of 120 numbers would evict each other from the cache in between.
LAUNCH = fused_kernel.LaunchConfig(block=64, warps=2, sample_axis=1)
UNROLL = 1  # joints in an iteration of a loop

Entries = dict[tuple[int, int], Scalar]  # of a 3 x 3 matrix, by row and column; of a symmetric one where row <= column
Rows = tuple[tuple[Scalar, ...], ...]  # values of each joint
JointStep = Callable[[Array, Any, tuple[Scalar, ...]], tuple[Any, tuple[Scalar, ...]]]
OverJoints = Callable[..., tuple[Any, Rows]]

_ALL = [(row, column) for row in range(3) for column in range(3)]
_UPPER = [(row, column) for row, column in _ALL if row <= column]


class Articulated(NamedTuple):
    """Articulated inertia of a joint's body with the bodies distal to it, and their bias wrench, in the joint's frame.

    An angular acceleration alpha and a linear acceleration l of the origin take the wrench

        moment = A alpha + B l + bias moment,    force = B^T alpha + C l + bias force.

    Attributes:
      a: A, symmetric [kg m^2].
      b: B [kg m].
      c: C, symmetric [kg]; 0 for one body, whose mass on the joint's axis is part of its parent.
      force: bias force [N]: with the joint accelerations that follow from alpha = 0 and l = 0.
      moment: bias moment about the origin [N m].
    """

    a: Entries
    b: Entries
    c: Entries
    force: Vector
    moment: Vector


def gpu_kernel(
    timestep: float, substeps: int, *, launch: fused_kernel.LaunchConfig = LAUNCH, unroll: int = UNROLL
) -> Callable[..., tuple[Array, ...]]:
    """A Pallas kernel of Runge-Kutta steps: (numbers, qpos, qvel, torque, load) -> (qpos, qvel).

    Its arguments are arrays [samples, width]: `dynamics.joint_numbers`, angles [rad], velocities [rad/s] and torques
    [N m] of the 8 slots of joints, and the factors on masses and damping.

    Args:
      timestep: duration of a step [s].
      substeps: steps per call.
      launch: launch configuration of the kernel.
      unroll: joints in an iteration of a loop, a divisor of 8. More are faster, and take longer to compile.
    """
    body = kernel_body(timestep, substeps, lambda bound, _: rotating_rows(bound, unroll))
    # A bound that is loaded keeps the compiler from unrolling the loops.
    bound = np.full(1, MAX_JOINTS // unroll, np.int32)
    return fused_kernel.by_columns(body, (MAX_JOINTS, MAX_JOINTS), bound, launch=launch)


def kernel_body(
    timestep: float, substeps: int, make_loop: Callable[[Any, Sequence[fused_kernel.Columns]], OverJoints]
) -> Callable[..., None]:
    """The body of the kernel, see `fused_kernel.by_columns`.

    Args:
      timestep: duration of a step [s].
      substeps: steps per call.
      make_loop: makes a loop over the joints, see `rotating_rows`, from the loaded number of its iterations and the
        outputs beyond qpos and qvel.
    """

    def body(inputs: Sequence[fused_kernel.Columns], outputs: Sequence[fused_kernel.Columns], bound_ref: Any) -> None:
        numbers, *states, torque, load = inputs
        # Column indices are arrays, because interpret mode rejects plain numbers.
        qpos, qvel, factors = (
            tuple(columns.read(jnp.asarray(k)) for k in range(columns.width)) for columns in (*states, load)
        )
        loop = make_loop(bound_ref[jnp.asarray(0)], outputs[2:])

        def joint_at(index: Array) -> JointNumbers:
            return dynamics.joint_of([numbers.read(dynamics.NUMBERS * index + k) for k in range(dynamics.NUMBERS)])

        torques = tuple(torque.read(jnp.asarray(k)) for k in range(torque.width))

        def qacc(qpos: tuple[Scalar, ...], qvel: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
            return acceleration(joint_at, loop, qpos, qvel, torques, factors)

        for columns, values in zip(outputs, runge_kutta(qacc, qpos, qvel, timestep, substeps), strict=False):
            for k, value in enumerate(values):
                columns.write(jnp.asarray(k), value)

    return body


def rotating_rows(bound: Scalar, unroll: int) -> OverJoints:
    """A loop over the joints that keeps the values of each joint in registers.

    The loop is a function (step, carry, rows, extra, reverse) -> (carry, rows). It calls step(index, carry, values) ->
    (carry, values) for each joint, from the base, or from the tip if `reverse`. `rows` are the values of each joint,
    followed by `extra` zeros. In each iteration the rows rotate by `unroll` places, so that their index is static.

    Args:
      bound: number of iterations.
      unroll: joints in an iteration.
    """

    def loop(step: JointStep, carry: Any, rows: Rows, extra: int = 0, reverse: bool = False) -> tuple[Any, Rows]:
        rows = tuple((*row, *[jnp.zeros_like(row[0])] * extra) for row in rows)
        places = range(unroll)[::-1] if reverse else range(unroll)

        def iteration(index: Array, state: tuple[Any, Rows]) -> tuple[Any, Rows]:
            carry, rows = state
            first = unroll * index
            if reverse:
                first, rows = MAX_JOINTS - unroll - first, rows[-unroll:] + rows[:-unroll]
            current = list(rows[:unroll])
            for k in places:
                carry, current[k] = step(first + k, carry, current[k])
            rows = (*current, *rows[unroll:])
            return carry, rows if reverse else rows[unroll:] + rows[:unroll]

        return jax.lax.fori_loop(0, bound, iteration, (carry, rows))

    return loop


def acceleration(
    joint_at: Callable[[Array], JointNumbers],
    loop: OverJoints,
    qpos: tuple[Scalar, ...],
    qvel: tuple[Scalar, ...],
    torque: tuple[Scalar, ...],
    load: tuple[Scalar, ...],
    base: Vector | None = None,
) -> tuple[Scalar, ...]:
    """Forward dynamics: joint accelerations [rad/s^2] under joint torques; 0 for locked joints.

    Args:
      joint_at: numbers of the joint of an index.
      loop: see `rotating_rows`.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s]; those of locked joints are 0.
      torque: joint torques [N m].
      load: factors on the masses and inertias of all bodies, and on the damping of all joints.
      base: acceleration of the base, in the frame of the first joint at angle 0 [m/s^2]: minus gravity. 0 where None.
    """
    # Longer than 40 lines: the steps of the loops share the arguments.
    zero, inverse_mass = jnp.zeros_like(qpos[0]), 1.0 / load[0]
    zeros: Vector = zero, zero, zero

    def outward(index: Array, motion: Motion, row: tuple[Scalar, ...]) -> Any:
        speed, angle, _, torque = row
        joint = joint_at(index)
        angle = angle + joint.reference
        turn = jnp.cos(angle), jnp.sin(angle)
        field = acceleration_field(motion[0], motion[1])
        return dynamics.child_motion(joint, turn, speed, motion, field), (speed, *turn, torque)

    def inward(index: Array, carry: tuple[Motion, Articulated], row: tuple[Scalar, ...]) -> Any:
        (motion, distal), (speed, *turn, torque) = carry, row[:4]
        joint, turn = joint_at(index), (turn[0], turn[1])
        # Dividing the other terms by the factor on masses is cheaper than multiplying the inertias by it.
        force = (torque - load[1] * joint.damping * speed) * inverse_mass
        inertia = with_body(distal, joint, motion)
        inertia, at_rest, by_parent = with_free_joint(inertia, joint, force, inverse_mass)
        carry = parent_motion(joint, turn, speed, motion), to_parent(inertia, joint, turn)
        return carry, (at_rest, *turn, *by_parent)

    def solve(index: Array, parent: tuple[Vector, Vector], row: tuple[Scalar, ...]) -> Any:
        at_rest, cosine, sine, *by_parent = row
        joint, turn, (alpha, linear) = joint_at(index), (cosine, sine), parent
        linear = dynamics.to_child(joint, turn, add(linear, cross(alpha, dynamics.offset_in_parent(joint))))
        alpha = dynamics.to_child(joint, turn, alpha)
        qacc = at_rest - dot(tuple(by_parent[:3]), linear) - dot(tuple(by_parent[3:]), alpha)
        return ((alpha[0], alpha[1], alpha[2] + qacc), linear), (qacc, *row[1:])

    at_base: Motion = zeros, zeros, zeros if base is None else base
    rows = tuple((v, q, zero, tau) for q, v, tau in zip(qpos, qvel, torque, strict=True))
    motion, rows = loop(outward, at_base, rows)
    symmetric = dict.fromkeys(_UPPER, zero)
    nothing = Articulated(symmetric, dict.fromkeys(_ALL, zero), symmetric, zeros, zeros)
    _, rows = loop(inward, (motion, nothing), rows, extra=5, reverse=True)
    _, rows = loop(solve, (zeros, zeros), rows)
    return tuple(row[0] for row in rows)


def parent_motion(joint: JointNumbers, turn: PLANE, speed: Scalar, motion: Motion) -> Motion:
    """The inverse of `dynamics.child_motion`: so the motion of each body need not be stored.

    Args:
      joint: the joint.
      turn: cosine and sine of its rotation.
      speed: its velocity [rad/s].
      motion: of the joint's body.
    """
    omega, alpha, linear = motion
    alpha = minus(alpha[0], times(omega[1], speed)), plus(alpha[1], times(omega[0], speed)), alpha[2]
    omega = omega[0], omega[1], minus(omega[2], speed)
    omega, alpha, linear = (_vector_to_parent(joint, turn, x) for x in (omega, alpha, linear))
    offset = rotate(acceleration_field(omega, alpha), dynamics.offset_in_parent(joint))
    return omega, alpha, subtract(linear, offset)


def with_body(distal: Articulated, joint: JointNumbers, motion: Motion) -> Articulated:
    """Adds the inertia and the bias wrench of a joint's own body to those of the distal bodies."""
    (x, y), (xx, yy, xy, xz, yz) = joint.first, joint.second
    a = {(0, 0): yy, (0, 1): times(-1.0, xy), (0, 2): times(-1.0, xz), (1, 1): xx, (1, 2): times(-1.0, yz)}
    a[2, 2] = plus(xx, yy)
    b = {(0, 2): y, (1, 2): times(-1.0, x), (2, 0): times(-1.0, y), (2, 1): x}  # first moment x l
    force, moment = dynamics.inertial_wrench(joint, motion[2], acceleration_field(motion[0], motion[1]))
    return Articulated(
        {entry: plus(value, a[entry]) for entry, value in distal.a.items()},
        {entry: plus(value, b.get(entry, 0.0)) for entry, value in distal.b.items()},
        distal.c,
        add(distal.force, force),
        add(distal.moment, moment),
    )


def with_free_joint(
    inertia: Articulated, joint: JointNumbers, force: Scalar, inverse_mass: Scalar
) -> tuple[Articulated, Scalar, tuple[Scalar, ...]]:
    """The articulated inertia that the parent body feels through a joint, in the joint's frame.

    Args:
      inertia: of the joint's body and the bodies distal to it.
      joint: the joint; a locked one transmits all.
      force: torque and damping over the factor on masses [N m].
      inverse_mass: one over this factor.

    Returns:
      The inertia; the joint's acceleration if its parent is at rest [rad/s^2]; and the decrease of that per unit of the
      parent's linear acceleration (3) and angular acceleration (3), both in the joint's frame.
    """
    a, b, c = inertia.a, inertia.b, inertia.c
    # Wrench of a unit acceleration of the joint: force, then moment.
    by_joint = [b[2, 0], b[2, 1], b[2, 2], a[0, 2], a[1, 2], a[2, 2]]
    inverse = joint.is_free / (a[2, 2] + joint.armature * inverse_mass)
    scaled = tuple(inverse * x for x in by_joint)
    left = force - inertia.moment[2]

    def without(entries: Entries, row: int, column: int) -> Entries:
        return {(r, s): x - scaled[row + r] * by_joint[column + s] for (r, s), x in entries.items()}

    transmitted = Articulated(
        without(a, 3, 3),
        without(b, 3, 0),
        without(c, 0, 0),
        add(inertia.force, scale(left, (scaled[0], scaled[1], scaled[2]))),
        add(inertia.moment, scale(left, (scaled[3], scaled[4], scaled[5]))),
    )
    return transmitted, inverse * left, scaled


def to_parent(inertia: Articulated, joint: JointNumbers, turn: PLANE) -> Articulated:
    """An articulated inertia of the joint's frame in the parent frame, about its origin.

    Args:
      inertia: in the joint's frame.
      joint: the joint.
      turn: cosine and sine of its rotation.
    """
    a, b = _turned_symmetric(turn, inertia.a, 0, 1), _turned(turn, inertia.b, 0, 1)
    c = _turned_symmetric(turn, inertia.c, 0, 1)
    a, b = _shifted(a, b, c, *joint.offset)
    twist = joint.twist
    a, b, c = _turned_symmetric(twist, a, 1, 2), _turned(twist, b, 1, 2), _turned_symmetric(twist, c, 1, 2)
    return Articulated(a, b, c, *dynamics.wrench_to_parent(joint, turn, inertia.force, inertia.moment))


def _shifted(a: Entries, b: Entries, c: Entries, x: Scalar, y: Scalar) -> tuple[Entries, Entries]:
    """A and B about a point at -(x, y, 0): B + S C and A + B S^T + S B^T + S C S^T, where S r = (x, y, 0) x r."""
    shifted = {}
    for k in range(3):
        c0, c1, c2 = (c[min(k, row), max(k, row)] for row in range(3))
        shifted[0, k] = b[0, k] + y * c2
        shifted[1, k] = b[1, k] - x * c2
        shifted[2, k] = b[2, k] + (x * c1 - y * c0)
    a = {
        (0, 0): a[0, 0] + y * (b[0, 2] + shifted[0, 2]),
        (0, 1): a[0, 1] + (y * shifted[1, 2] - x * b[0, 2]),
        (0, 2): a[0, 2] + (x * b[0, 1] + y * (shifted[2, 2] - b[0, 0])),
        (1, 1): a[1, 1] - x * (b[1, 2] + shifted[1, 2]),
        (1, 2): a[1, 2] + (x * (b[1, 1] - shifted[2, 2]) - y * b[1, 0]),
        (2, 2): a[2, 2] + (x * (b[2, 1] + shifted[2, 1]) - y * (b[2, 0] + shifted[2, 0])),
    }
    return a, shifted


def _vector_to_parent(joint: JointNumbers, turn: PLANE, a: Vector) -> Vector:
    x, y = turned(turn, a[0], a[1])
    return x, *turned(joint.twist, y, a[2])


def _turned(turn: PLANE, matrix: Entries, i: int, j: int) -> Entries:
    """R M R^T for a rotation R in the plane of the axes i and j."""
    matrix = dict(matrix)
    for column in range(3):
        matrix[i, column], matrix[j, column] = turned(turn, matrix[i, column], matrix[j, column])
    for row in range(3):
        matrix[row, i], matrix[row, j] = turned(turn, matrix[row, i], matrix[row, j])
    return matrix


def _turned_symmetric(turn: PLANE, matrix: Entries, i: int, j: int) -> Entries:
    """The same for a symmetric matrix, i < j."""
    matrix, other = dict(matrix), 3 - i - j
    matrix[i, i], matrix[j, j], matrix[i, j] = turned_tensor(turn, matrix[i, i], matrix[j, j], matrix[i, j])
    one, two = (min(i, other), max(i, other)), (min(j, other), max(j, other))
    matrix[one], matrix[two] = turned(turn, matrix[one], matrix[two])
    return matrix
