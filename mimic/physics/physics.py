"""Simulation of any arm: steps with the numbers of the arm as one more argument."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mimic.arms.arrays import MAX_JOINTS, ArmArrays
from mimic.base import fused_kernel
from mimic.physics import composite_kernel, looped_dynamics
from mimic.physics.joint_numbers import NUMBERS, joint_numbers
from mimic.physics.step import Load, runge_kutta

AdvanceAny = Callable[[ArmArrays, Array, Array, Array, Load], tuple[Array, Array]]


def make_advance(timestep: float, substeps: int) -> AdvanceAny:
    """Makes a function (arm, qpos, qvel, torque, load) -> (qpos, qvel) of `substeps` steps with a constant torque.

    It integrates the forward dynamics by the classical fourth-order Runge-Kutta method, as MuJoCo's RK4 does. It takes
    one sample, and is a single kernel on NVIDIA GPUs if it is batched by `jax.vmap`. The vectors have a number for each
    slot of a joint, [joints]; velocities of locked joints must be 0, and these joints stay at their angle in qpos.

    Args:
      timestep: duration of a step [s].
      substeps: steps per call.
    """
    kernel = composite_kernel.gpu_kernel(timestep, substeps)
    plain = jax.jit(array_step(timestep, substeps))
    step = fused_kernel.batched_by(kernel, plain, fused_kernel.with_batch_last(plain))

    def advance(
        arm: ArmArrays,
        qpos: Float[Array, " joints"],
        qvel: Float[Array, " joints"],
        torque: Float[Array, " joints"],
        load: Load,
    ) -> tuple[Float[Array, " joints"], Float[Array, " joints"]]:
        factors = jnp.stack([jnp.asarray(x, qpos.dtype) for x in load])
        numbers = joint_numbers(arm).astype(qpos.dtype)
        qpos, qvel = step(numbers, qpos, qvel, torque, factors)
        return qpos, qvel

    return advance


def array_step(timestep: float, substeps: int) -> Callable[..., tuple[Array, ...]]:
    """The steps on arrays [size, *batch], for other devices and for derivatives."""

    def step(numbers: Array, qpos: Array, qvel: Array, torque: Array, load: Array) -> tuple[Array, ...]:
        by_joint = numbers.reshape(MAX_JOINTS, NUMBERS, *numbers.shape[1:])

        def acceleration(qpos: Array, qvel: Array) -> Array:
            return looped_dynamics.acceleration(by_joint, qpos, qvel, torque, *load)

        return runge_kutta(acceleration, qpos, qvel, timestep, substeps)

    return step
