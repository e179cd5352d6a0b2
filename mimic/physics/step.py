"""Simulation of the learner, from torques to joint states: by MJX, or by mimic's own dynamics in a fused kernel."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array
from mujoco import mjx

from mimic.arms.embodiment import LONG
from mimic.base import fused_kernel
from mimic.physics import dynamics
from mimic.physics.joint_numbers import JointNumbers, joints_of_model, uncovered_elements
from mimic.physics.trigonometry import cosine_and_sine
from mimic.physics.world import AUTO

_LAUNCH = fused_kernel.LaunchConfig(block=64, warps=2)  # the fastest by measurement


class PhysicsChoice(NamedTuple):
    """The physics that simulates an arm: "mjx" or "fused", and why."""

    name: str
    reason: str


Advance = Callable[[Array, Array, Array], tuple[Array, Array]]


def choose_physics(physics: str, model: mujoco.MjModel) -> PhysicsChoice:
    """Resolves "auto": "fused" for a model that it covers exactly and compiles quickly, otherwise "mjx".

    Args:
      physics: see `EnvConfig`.
      model: the learner's, from `simulation_model`.
    """
    if physics != AUTO:
        return PhysicsChoice(physics, "as configured")
    uncovered = uncovered_elements(model)
    if uncovered:
        return PhysicsChoice("mjx", f"auto: the fused dynamics do not cover {', '.join(uncovered)}")
    if model.njnt > LONG:
        return PhysicsChoice(
            "mjx", f"auto: the fused dynamics of more than {LONG} joints compile slowly, got {model.njnt}"
        )
    return PhysicsChoice("fused", "auto: it covers the learner exactly")


def make_advance(model: mujoco.MjModel, timestep: float, substeps: int, physics: str = "mjx") -> Advance:
    """Makes a function (qpos, qvel, torque) -> (qpos, qvel) of `substeps` steps with a constant torque.

    It integrates the forward dynamics by the classical fourth-order Runge-Kutta method, as MuJoCo's RK4 does.

    Args:
      model: from `simulation_model`: revolute joints only, no constraints.
      timestep: duration of a step [s].
      substeps: steps per call.
      physics: "mjx", or "fused" for the same equations in one fused function: a single kernel on NVIDIA GPUs.
    """
    make = {"mjx": _mjx_advance, "fused": _fused_advance}[physics]
    return make(model, timestep, substeps)


def _mjx_advance(model: mujoco.MjModel, timestep: float, substeps: int) -> Advance:
    device = jax.local_devices()[0]  # MJX would choose a device of process 0, which other processes cannot use
    constants = jax.device_get((mjx.put_model(model, device=device), mjx.make_data(model, device=device)))

    def advance(qpos: Array, qvel: Array, torque: Array) -> tuple[Array, Array]:
        mjx_model, blank = jax.tree.map(constant, constants)

        def acceleration(qpos: Array, qvel: Array) -> Array:
            # `Data` is not carried from step to step: a step needs only its joint state.
            data = blank.replace(qpos=qpos, qvel=qvel, qfrc_applied=torque)
            return mjx.forward(mjx_model, data).qacc

        return runge_kutta(acceleration, qpos, qvel, timestep, substeps)

    return advance


def constant(value: Any) -> Array:
    """A constant array. Empty ones are computed: jaxlib 0.11.2 crashes on empty literals with several devices."""
    return jnp.asarray(value) if value.size else jnp.zeros(value.shape, value.dtype)


def _fused_advance(model: mujoco.MjModel, timestep: float, substeps: int) -> Advance:
    joints = joints_of_model(model)

    def plain(qpos: Array, qvel: Array, torque: Array) -> tuple[Array, Array]:
        def acceleration(qpos: Array, qvel: Array) -> Array:
            return jnp.stack(dynamics.acceleration(joints, list(qpos), list(qvel), list(torque)))

        return runge_kutta(acceleration, qpos, qvel, timestep, substeps)

    # For CPUs: a loop over a few arrays is twice as fast as a loop over an array for each joint.
    widths = len(joints), len(joints)
    step = fused_kernel.fused(_scalar_step(joints, timestep, substeps), widths, plain=plain, launch=_LAUNCH)

    def advance(qpos: Array, qvel: Array, torque: Array) -> tuple[Array, Array]:
        qpos, qvel = step(qpos, qvel, torque)
        return qpos, qvel

    return advance


def _scalar_step(joints: tuple[JointNumbers, ...], timestep: float, substeps: int) -> fused_kernel.ScalarFunction:
    """The steps on scalar components, for the kernel."""

    def step(qpos: Any, qvel: Any, torque: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        def acceleration(qpos: Any, qvel: Any) -> tuple[Any, ...]:
            return dynamics.acceleration(joints, qpos, qvel, torque, trigonometry=cosine_and_sine)

        return runge_kutta(acceleration, tuple(qpos), tuple(qvel), timestep, substeps)

    return step


def runge_kutta(
    acceleration: Callable[[Any, Any], Any], qpos: Any, qvel: Any, timestep: float, substeps: int
) -> tuple[Any, Any]:
    """Runge-Kutta steps of arrays or tuples of arrays. A loop over the stages compiles the dynamics only once."""
    dtype = jax.tree.leaves(qpos)[0].dtype

    def extrapolate(start: Any, duration: Any, rate: Any) -> Any:
        return jax.tree.map(lambda x, y: x + duration * y, start, rate)

    def stage(index: Any, carry: Any) -> Any:
        start, (stage_qpos, stage_qvel), (end_qpos, end_qvel) = carry
        qacc = acceleration(stage_qpos, stage_qvel)
        weight = timestep / 6 * (1 + jnp.minimum(index, 3 - index)).astype(dtype)  # of the stages: 1 2 2 1
        to_next = timestep / 2 * (1 + index // 2).astype(dtype)  # from the start of the step to the next stage: 1 1 2
        return (
            start,
            (extrapolate(start[0], to_next, stage_qvel), extrapolate(start[1], to_next, qacc)),
            (extrapolate(end_qpos, weight, stage_qvel), extrapolate(end_qvel, weight, qacc)),
        )

    def step(_: Any, start: Any) -> Any:
        return jax.lax.fori_loop(0, 4, stage, (start, start, start))[2]

    return jax.lax.fori_loop(0, substeps, step, (qpos, qvel))
