"""The learner's motion: torque in, joint state out, on MJX."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float
from mujoco import mjx

Advance = Callable[[Array, Array, Array], tuple[Array, Array]]


def make_advance(model: mujoco.MjModel, timestep: float, substeps: int) -> Advance:
    """A function (qpos, qvel, torque) -> (qpos, qvel) that holds the torque for `substeps` steps of `timestep` seconds.

    Classical fourth-order Runge-Kutta, as MuJoCo's RK4, over MJX's forward dynamics. The stages run in a scan, so that
    the dynamics are traced and compiled once and not, as in `mjx.step`, four times.

    Args:
      model: from `simulation_model`: hinges only, no constraints.
      timestep: [s].
      substeps: steps per call.
    """
    mjx_model = mjx.put_model(model)
    blank = mjx.make_data(model)
    weights = jnp.array([1, 2, 2, 1]) / 6 * timestep  # of each stage's derivative in the step
    reaches = jnp.array([1, 1, 2, 0]) / 2 * timestep  # from the start of the step to the next stage

    def acceleration(qpos: Array, qvel: Array, torque: Array) -> Array:
        # `Data` is rebuilt here and never carried: all that a step needs of it is the joint state.
        data = blank.replace(qpos=qpos, qvel=qvel, qfrc_applied=torque)
        return mjx.forward(mjx_model, data).qacc

    def advance(
        qpos: Float[Array, " joints"], qvel: Float[Array, " joints"], torque: Float[Array, " joints"]
    ) -> tuple[Float[Array, " joints"], Float[Array, " joints"]]:
        def step(start, _):
            def stage(carry, coefficients):
                stage_qpos, stage_qvel, end_qpos, end_qvel = carry
                weight, reach = coefficients
                qacc = acceleration(stage_qpos, stage_qvel, torque)
                next_stage = start[0] + reach * stage_qvel, start[1] + reach * qacc
                return (*next_stage, end_qpos + weight * stage_qvel, end_qvel + weight * qacc), None

            (_, _, *end), _ = jax.lax.scan(stage, (*start, *start), (weights, reaches))
            return tuple(end), None

        return jax.lax.scan(step, (qpos, qvel), None, length=substeps)[0]

    return advance
