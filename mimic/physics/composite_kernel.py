"""Steps of an arm as data: on GPUs one kernel of the equations of mimic/physics/dynamics.py for all joints.

The compile time of a Triton kernel is almost that of its pass `coalesce`: the number of loads and stores times the
square of the number of operations. So loops load the numbers and store the result: there are 7 loads and stores instead
of 170. Nothing else is a loop over the joints. An evaluation of the dynamics has 2100 instructions, a loop over the
joints 1200 for each of them, most of which move values of the joints between registers and compute addresses.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS, ArmArrays
from mimic.base import fused_kernel
from mimic.base.spatial import Scalar
from mimic.physics import looped_dynamics
from mimic.physics.dynamics import acceleration, with_locks
from mimic.physics.joint_numbers import NUMBERS, JointNumbers, joint_numbers, joint_of
from mimic.physics.step import runge_kutta
from mimic.physics.trigonometry import cosine_and_sine

LAUNCH = fused_kernel.LaunchConfig(block=64, warps=2)  # the fastest measured on an H100

Rows = tuple[tuple[Scalar, ...], ...]  # values of each joint


AdvanceAny = Callable[[ArmArrays, Array, Array, Array], tuple[Array, Array]]


def make_advance(timestep: float, substeps: int) -> AdvanceAny:
    """Makes a function (arm, qpos, qvel, torque) -> (qpos, qvel) of `substeps` steps with a constant torque.

    It integrates the forward dynamics by the classical fourth-order Runge-Kutta method, as MuJoCo's RK4 does. It takes
    one sample, and is a single kernel on NVIDIA GPUs if it is batched by `jax.vmap`. The vectors have a number for each
    slot of a joint, [joints]; velocities of locked joints must be 0, and these joints stay at their angle in qpos.

    Args:
      timestep: duration of a step [s].
      substeps: steps per call.
    """
    kernel = gpu_kernel(timestep, substeps)
    plain = jax.jit(array_step(timestep, substeps))
    step = fused_kernel.batched_by(kernel, plain, fused_kernel.with_batch_last(plain))

    def advance(
        arm: ArmArrays,
        qpos: Float[Array, " joints"],
        qvel: Float[Array, " joints"],
        torque: Float[Array, " joints"],
    ) -> tuple[Float[Array, " joints"], Float[Array, " joints"]]:
        numbers = joint_numbers(arm).astype(qpos.dtype)
        qpos, qvel = step(numbers, qpos, qvel, torque)
        return qpos, qvel

    return advance


def array_step(timestep: float, substeps: int) -> Callable[..., tuple[Array, ...]]:
    """The steps on arrays [size, *batch], for other devices and for derivatives."""

    def step(numbers: Array, qpos: Array, qvel: Array, torque: Array) -> tuple[Array, ...]:
        by_joint = numbers.reshape(MAX_JOINTS, NUMBERS, *numbers.shape[1:])

        def acceleration(qpos: Array, qvel: Array) -> Array:
            return looped_dynamics.acceleration(by_joint, qpos, qvel, torque)

        return runge_kutta(acceleration, qpos, qvel, timestep, substeps)

    return step


def gpu_kernel(
    timestep: float, substeps: int, *, launch: fused_kernel.LaunchConfig = LAUNCH
) -> Callable[..., tuple[Array, ...]]:
    """A Pallas kernel of Runge-Kutta steps: (numbers, qpos, qvel, torque) -> (qpos, qvel).

    Its arguments are arrays [samples, width]: `joint_numbers`, angles [rad], velocities [rad/s] and torques
    [N m] of the 8 slots of joints.

    Args:
      timestep: duration of a step [s].
      substeps: steps per call.
      launch: launch configuration of the kernel.
    """

    def body(inputs: Sequence[fused_kernel.Columns], outputs: Sequence[fused_kernel.Columns]) -> None:
        numbers, *states, torque = inputs
        joints = with_locks(read_joints(numbers))
        force = [x for (x,) in read_rows(torque)]

        def qacc(qpos: tuple[Scalar, ...], qvel: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
            return acceleration(joints, qpos, qvel, force, trigonometry=cosine_and_sine)

        qpos, qvel = (tuple(x for (x,) in read_rows(columns)) for columns in states)
        for columns, values in zip(outputs, runge_kutta(qacc, qpos, qvel, timestep, substeps), strict=True):
            write_rows(columns, [(x,) for x in values])

    return fused_kernel.by_columns(body, (MAX_JOINTS, MAX_JOINTS), launch=launch)


def read_joints(numbers: fused_kernel.Columns, count: int = MAX_JOINTS) -> list[JointNumbers]:
    """The joints of a serial arm, from the columns of `joint_numbers`."""
    return [joint_of(row, index - 1) for index, row in enumerate(read_rows(numbers, count))]


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
