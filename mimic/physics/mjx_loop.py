"""The inner loop with MJX as its physics: what the fused loop covers, and contacts."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from mujoco import mjx

from mimic.control import joint_control
from mimic.physics.inner_loop import LoopState, control
from mimic.physics.mujoco_world import MujocoWorld, loaded_fields
from mimic.physics.plant import Draw, Plant
from mimic.physics.step import constant

MjxLoop = Callable[[Draw, LoopState, Array], LoopState]


def make_mjx_loop(mode: str, plant: Plant, world: MujocoWorld, periods: int) -> MjxLoop:
    """Makes a function (draw, state, target) -> state after `periods` ms; vectors are [joints].

    Args:
      mode: one of `joint_control.MODES`.
      plant: the learner with its drives.
      world: its model.
      periods: duration [ms].
    """
    assert mode in joint_control.MODES
    # The stops are those of MuJoCo.
    none = np.zeros(world.model.nv)
    constants = plant.constants._replace(stop_stiffness=none, stop_damping=none)
    device = jax.local_devices()[0]
    parts = jax.device_get((mjx.put_model(world.model, device=device), mjx.make_data(world.model, device=device)))

    def loop(draw: Draw, state: LoopState, target: Array) -> LoopState:
        model, data = jax.tree.map(constant, parts)
        model = _with_draw(model, world, draw)
        by_row = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), constants)
        drive = draw.gain, draw.friction * jnp.asarray(plant.friction, jnp.float32), draw.bias

        def period(_: int, carry: tuple[mjx.Data, LoopState]) -> tuple[mjx.Data, LoopState]:
            data, state = carry
            reference, torque, acting = control(mode, by_row, state, target, drive)
            data = mjx.step(model, data.replace(qfrc_applied=acting))
            return data, LoopState(data.qpos, data.qvel, reference, torque)

        data = data.replace(qpos=state.qpos, qvel=state.qvel)
        return jax.lax.fori_loop(0, periods, period, (data, state))[1]

    return loop


def _with_draw(model: mjx.Model, world: MujocoWorld, draw: Draw) -> mjx.Model:
    """The model with the masses, the payload and the gravity of an episode."""
    fields = loaded_fields(world, draw.gravity_error, draw.link_mass, draw.payload, draw.payload_lever, jnp)
    return model.replace(
        opt=model.opt.replace(gravity=fields.gravity),
        body_mass=fields.body_mass,
        body_inertia=fields.body_inertia,
        body_ipos=fields.body_ipos,
    )
