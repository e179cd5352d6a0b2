"""The learner's motion: torque in, joint state out; on MJX, or by our own dynamics as one fused program."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Float
from mujoco import mjx

from mimic.envs import dynamics

_BLOCK, _WARPS = 64, 2  # arms, and groups of 32 threads, in a block of the GPU kernel (by measurement)


class Load(NamedTuple):
    """How an arm differs from its model.

    Attributes:
      mass: factor of the masses and inertias of its bodies.
      damping: factor of the damping of its joints.
    """

    mass: Float[Array, ""] | float = 1.0
    damping: Float[Array, ""] | float = 1.0


Advance = Callable[[Array, Array, Array, Load], tuple[Array, Array]]


def make_advance(model: mujoco.MjModel, timestep: float, substeps: int, physics: str = "mjx") -> Advance:
    """A function (qpos, qvel, torque, load) -> (qpos, qvel) that holds a torque for `substeps` steps.

    Classical fourth-order Runge-Kutta, as MuJoCo's RK4, over the forward dynamics.

    Args:
      model: from `simulation_model`: hinges only, no constraints.
      timestep: of a step [s].
      substeps: steps per call.
      physics: "mjx", or "fused" for the same equations as one small program: a single kernel on NVIDIA GPUs.
    """
    make = {"mjx": _mjx_advance, "fused": _fused_advance}[physics]
    return make(model, timestep, substeps)


def _mjx_advance(model: mujoco.MjModel, timestep: float, substeps: int) -> Advance:
    mjx_model = mjx.put_model(model)
    blank = mjx.make_data(model)

    def advance(qpos: Array, qvel: Array, torque: Array, load: Load) -> tuple[Array, Array]:
        loaded = mjx_model.replace(
            body_mass=load.mass * mjx_model.body_mass,
            body_inertia=load.mass * mjx_model.body_inertia,
            dof_damping=load.damping * mjx_model.dof_damping,
        )

        def acceleration(qpos: Array, qvel: Array) -> Array:
            # `Data` is rebuilt here and never carried: all that a step needs of it is the joint state.
            data = blank.replace(qpos=qpos, qvel=qvel, qfrc_applied=torque)
            return mjx.forward(loaded, data).qacc

        return _runge_kutta(acceleration, qpos, qvel, timestep, substeps)

    return advance


def _fused_advance(model: mujoco.MjModel, timestep: float, substeps: int) -> Advance:
    arm = dynamics.segments(model)

    @jax.custom_batching.custom_vmap
    def advance(qpos: Array, qvel: Array, torque: Array, mass: Array, damping: Array) -> tuple[Array, Array]:
        def acceleration(qpos: Array, qvel: Array) -> Array:
            return jnp.stack(dynamics.acceleration(arm, list(qpos), list(qvel), list(torque), mass, damping))

        return _runge_kutta(acceleration, qpos, qvel, timestep, substeps)

    kernel = _kernel(arm, timestep, substeps)
    plain = jax.vmap(advance.fun)

    @advance.def_vmap
    def many(size: int, batched: Any, *arguments: Any) -> Any:
        rows = [
            argument if is_batched else jnp.broadcast_to(argument, (size, *jnp.shape(argument)))
            for argument, is_batched in zip(arguments, batched, strict=True)
        ]
        return jax.lax.platform_dependent(*rows, cuda=kernel, default=plain), (True, True)

    return lambda qpos, qvel, torque, load: advance(qpos, qvel, torque, *(jnp.asarray(x, qpos.dtype) for x in load))


def _kernel(arm: tuple[dynamics.Segment, ...], timestep: float, substeps: int) -> Callable[..., Any]:
    """The batched step as one GPU kernel: an arm stays in the registers of one thread from start to end.

    XLA would split the dynamics into many kernels, and each of their results would go through memory.
    """
    joints = range(len(arm))

    def kernel(qpos: Any, qvel: Any, torque: Any, load: Any, qpos_out: Any, qvel_out: Any) -> None:
        held = tuple(torque[i, :] for i in joints)

        def acceleration(qpos: Any, qvel: Any) -> Any:
            return tuple(dynamics.acceleration(arm, qpos, qvel, held, load[0, :], load[1, :]))

        start = tuple(qpos[i, :] for i in joints), tuple(qvel[i, :] for i in joints)
        end = _runge_kutta(acceleration, *start, timestep, substeps)
        for i in joints:
            qpos_out[i, :], qvel_out[i, :] = end[0][i], end[1][i]

    def batched(qpos: Array, qvel: Array, torque: Array, mass: Array, damping: Array) -> tuple[Array, Array]:
        count = qpos.shape[0]
        blocks = -(-count // _BLOCK)

        def rows(columns: Array) -> Array:  # of one quantity for all arms, so that threads read side by side
            return jnp.pad(columns.T, ((0, 0), (0, blocks * _BLOCK - count)), constant_values=1.0)

        arguments = [rows(x) for x in (qpos, qvel, torque, jnp.stack([mass, damping], axis=1))]
        shape = jax.ShapeDtypeStruct(arguments[0].shape, qpos.dtype)
        end = pl.pallas_call(
            kernel,
            out_shape=(shape, shape),
            grid=(blocks,),
            in_specs=[pl.BlockSpec((len(x), _BLOCK), lambda i: (0, i)) for x in arguments],
            out_specs=[pl.BlockSpec((len(arm), _BLOCK), lambda i: (0, i))] * 2,
            compiler_params=triton.CompilerParams(num_warps=_WARPS, num_stages=1),
        )(*arguments)
        return end[0].T[:count], end[1].T[:count]

    return batched


def _runge_kutta(
    acceleration: Callable[[Any, Any], Any], qpos: Any, qvel: Any, timestep: float, substeps: int
) -> tuple[Any, Any]:
    """Steps over arrays or tuples of them. The stages run in a loop, so that the dynamics are compiled once."""
    dtype = jax.tree.leaves(qpos)[0].dtype

    def along(start: Any, reach: Any, rate: Any) -> Any:
        return jax.tree.map(lambda x, y: x + reach * y, start, rate)

    def stage(index: Any, carry: Any) -> Any:
        start, (stage_qpos, stage_qvel), (end_qpos, end_qvel) = carry
        qacc = acceleration(stage_qpos, stage_qvel)
        weight = timestep / 6 * (1 + jnp.minimum(index, 3 - index)).astype(dtype)  # 1 2 2 1, of this stage in the step
        reach = timestep / 2 * (1 + index // 2).astype(dtype)  # 1 1 2, from the start of the step to the next stage
        return (
            start,
            (along(start[0], reach, stage_qvel), along(start[1], reach, qacc)),
            (along(end_qpos, weight, stage_qvel), along(end_qvel, weight, qacc)),
        )

    def step(_: Any, start: Any) -> Any:
        return jax.lax.fori_loop(0, 4, stage, (start, start, start))[2]

    return jax.lax.fori_loop(0, substeps, step, (qpos, qvel))
