"""Steps of any arm in one GPU kernel: the equations of mimic/physics/dynamics.py for all joints, without loops.

The compile time of a Triton kernel is almost that of its pass `coalesce`: the number of loads and stores times the
square of the number of operations. So loops load the numbers and store the result: there are 7 loads and stores instead
of 170. Nothing else is a loop over the joints. An evaluation of the dynamics has 2100 instructions, a loop over the
joints 1200 for each of them, most of which move values of the joints between registers and compute addresses.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from mimic.arms.arrays import MAX_JOINTS
from mimic.base import fused_kernel
from mimic.base.spatial import Scalar, Vector, minus, plus, times
from mimic.physics import dynamics
from mimic.physics.dynamics import JointNumbers
from mimic.physics.step import runge_kutta
from mimic.physics.trigonometry import cosine_and_sine

LAUNCH = fused_kernel.LaunchConfig(block=64, warps=2)  # the fastest measured on an H100

Rows = tuple[tuple[Scalar, ...], ...]  # values of each joint


def gpu_kernel(
    timestep: float, substeps: int, *, launch: fused_kernel.LaunchConfig = LAUNCH
) -> Callable[..., tuple[Array, ...]]:
    """A Pallas kernel of Runge-Kutta steps: (numbers, qpos, qvel, torque, load) -> (qpos, qvel).

    Its arguments are arrays [samples, width]: `dynamics.joint_numbers`, angles [rad], velocities [rad/s] and torques
    [N m] of the 8 slots of joints, and the factors on masses and damping.

    Args:
      timestep: duration of a step [s].
      substeps: steps per call.
      launch: launch configuration of the kernel.
    """

    def body(inputs: Sequence[fused_kernel.Columns], outputs: Sequence[fused_kernel.Columns]) -> None:
        numbers, *states, torque, load = inputs
        ((mass, damping),) = read_rows(load, 1)
        joints = [loaded(dynamics.joint_of(row), mass, damping) for row in read_rows(numbers)]
        force = [x / mass for (x,) in read_rows(torque)]

        def qacc(qpos: tuple[Scalar, ...], qvel: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
            return acceleration(joints, qpos, qvel, force)

        qpos, qvel = (tuple(x for (x,) in read_rows(columns)) for columns in states)
        for columns, values in zip(outputs, runge_kutta(qacc, qpos, qvel, timestep, substeps), strict=True):
            write_rows(columns, [(x,) for x in values])

    return fused_kernel.by_columns(body, (MAX_JOINTS, MAX_JOINTS), launch=launch)


def read_rows(columns: fused_kernel.Columns, count: int = MAX_JOINTS) -> Rows:
    """The columns of an array as rows: those of the first joint, of the second, ...

    Args:
      columns: of the array.
      count: of the joints.
    """
    width = columns.width // count
    empty = (jnp.zeros(columns.mask.shape, columns.ref.dtype),) * width

    def read_row(index: Array, rows: Rows) -> Rows:
        def read(k: Array, row: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
            return (*row[1:], columns.read(width * index + k))

        return (*rows[1:], _loop(width, read, empty))

    return _loop(count, read_row, (empty,) * count)


def write_rows(columns: fused_kernel.Columns, rows: Sequence[Sequence[Scalar]]) -> None:
    """Writes the values of each joint, the inverse of `read_rows`."""
    width = len(rows[0])

    def write_row(index: Array, rows: Rows) -> Rows:
        def write(k: Array, row: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
            columns.write(width * index + k, row[0])
            return (*row[1:], row[0])

        return (*rows[1:], _loop(width, write, rows[0]))

    _loop(len(rows), write_row, tuple(tuple(row) for row in rows))


def _loop(count: int, step: Callable[[Array, Any], Any], start: Any) -> Any:
    return jax.lax.fori_loop(0, count, step, start) if count > 1 else step(jnp.asarray(0), start)


def loaded(joint: JointNumbers, mass: Scalar, damping: Scalar) -> JointNumbers:
    """The numbers of a joint under a load, over the factor on masses: dividing these few is cheaper than multiplying.

    The armature of a locked joint is infinite, so that its acceleration is 0.

    Args:
      joint: the joint.
      mass: factor on the masses and inertias of all bodies.
      damping: factor on the damping of all joints.
    """
    armature = jnp.where(joint.is_free > 0, joint.armature / mass, math.inf)
    return joint._replace(armature=armature, damping=joint.damping * damping / mass)


def acceleration(
    joints: Sequence[JointNumbers],
    qpos: Sequence[Scalar],
    qvel: Sequence[Scalar],
    torque: Sequence[Scalar],
    base: Vector | None = None,
) -> tuple[Scalar, ...]:
    """Forward dynamics: joint accelerations [rad/s^2] under joint torques; 0 for locked joints.

    Args:
      joints: from `loaded`.
      qpos: joint angles [rad].
      qvel: joint velocities [rad/s]; those of locked joints are 0.
      torque: joint torques over the factor on masses [N m].
      base: acceleration of the base, in the frame of the first joint at angle 0 [m/s^2]: minus gravity. 0 where None.
    """
    # The angle of the first joint has no effect where the base is at rest.
    turns = [(1.0, 0.0)] if base is None else []
    for joint, angle in list(zip(joints, qpos, strict=True))[len(turns) :]:
        turns.append(cosine_and_sine(angle + joint.reference))
    wrenches = dynamics.inertial_wrenches(joints, turns, qvel, base)
    rows = dynamics.rows_of_inertia(joints, turns, wrenches)
    elimination = _Elimination(len(joints))
    for k, (row, bias) in zip(reversed(range(len(joints))), rows, strict=True):
        elimination.add(k, row, joints[k].armature, torque[k] - joints[k].damping * qvel[k] - bias)
    return elimination.solution()


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
        inverse = 1.0 / plus(row[k], armature)
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
