"""The task as brax and MuJoCo Playground environments usually implement it: `mjx.Data` is the state."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from brax.envs.base import State, Wrapper
from brax.envs.wrappers.training import wrap as wrap
from mujoco import mjx

from mimic.envs.imitation import ArmState, ImitationEnv


def model_with_substeps(env: ImitationEnv) -> mujoco.MjModel:
    """The learner's model with the time step of the environment's substeps."""
    model = env.arm.model.__copy__()
    model.opt.timestep = env.config.control_dt / env.config.substeps
    return model


class StockEnv(Wrapper):
    """Reward, observation and torques are the imitation environment's; brax resets each arm to its first state."""

    def __init__(self, imitation: ImitationEnv):
        super().__init__(imitation)
        model = model_with_substeps(imitation)
        self._imitation, self._model, self._blank = imitation, mjx.put_model(model), mjx.make_data(model)

    def reset(self, rng: jax.Array) -> State:
        start = self._imitation.start(rng)
        data = mjx.forward(self._model, self._blank.replace(qpos=start.qpos, qvel=start.qvel))
        zero = jnp.zeros(())
        info = {"arm_state": start}
        return State(data, self._imitation.observe(start), zero, zero, {"distance": zero}, info)  # type: ignore[arg-type]

    def step(self, state: State, action: jax.Array) -> State:
        config, before = self._imitation.config, state.info["arm_state"]
        data: Any = state.pipeline_state
        data = data.replace(qfrc_applied=jnp.clip(action, -1.0, 1.0) * self._imitation.torque_scale)
        data = jax.lax.fori_loop(0, config.substeps, lambda _, d: mjx.step(self._model, d), data)
        step = jnp.round(data.time / config.control_dt).astype(jnp.int32)  # the time is reset with the data
        after: ArmState = dataclasses.replace(before, qpos=data.qpos, qvel=data.qvel, step=step)
        distance = self._imitation.distance(after.qpos, after.qvel, after.demonstration, step)
        return state.replace(
            pipeline_state=data,
            obs=self._imitation.observe(after),
            reward=-distance,
            done=(step >= config.horizon).astype(jnp.float32),
            metrics={**state.metrics, "distance": distance},
            info={**state.info, "arm_state": after},
        )
