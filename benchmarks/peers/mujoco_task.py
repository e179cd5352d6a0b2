"""The task on C MuJoCo, one arm at a time, as it was before there was physics on accelerators."""

import dataclasses
from typing import Any

import jax
import mujoco
import numpy as np

from mimic.envs.imitation import ArmState, ImitationEnv


class MujocoTask:
    """Steps one arm; reward and observation are the imitation environment's, compiled for the processor."""

    def __init__(self, imitation: ImitationEnv, seed: int):
        config = imitation.config
        self._model = imitation.arm.model.__copy__()
        self._model.opt.timestep = config.control_dt / config.substeps
        self._data = mujoco.MjData(self._model)
        self._imitation, self._substeps = imitation, config.substeps
        self._torque_scale, self._home = np.asarray(imitation.torque_scale, float), np.asarray(imitation.learner.home)
        self._random = np.random.default_rng(seed)
        self._processor = jax.local_devices(backend="cpu")[0]
        with jax.default_device(self._processor):
            self._blank = jax.device_get(dataclasses.replace(imitation.start(jax.random.PRNGKey(0)), load=None))
        self._seen = jax.jit(self._look)
        self._step = self._demonstration = 0

    def _look(self, state: ArmState) -> tuple[jax.Array, jax.Array]:
        distance = self._imitation.distance(state.qpos, state.qvel, state.demonstration, state.step)
        return self._imitation.observe(state), -distance

    def _now(self) -> tuple[np.ndarray, float]:
        state = dataclasses.replace(
            self._blank,
            qpos=self._data.qpos.astype(np.float32),
            qvel=self._data.qvel.astype(np.float32),
            step=np.int32(self._step),  # type: ignore[arg-type]
            demonstration=np.int32(self._demonstration),  # type: ignore[arg-type]
        )
        with jax.default_device(self._processor):
            observation, reward = jax.device_get(self._seen(state))
        return observation, float(reward)

    def reset(self, demonstration: int | None = None) -> np.ndarray:
        """At rest in the home pose, on a random demonstration where none is named; the observation."""
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = self._home
        count = self._imitation.demonstrations.count
        self._demonstration = int(self._random.integers(count)) if demonstration is None else demonstration
        self._step = 0
        return self._now()[0]

    def step(self, action: Any) -> tuple[np.ndarray, float, bool]:
        """Holds a torque for one control step: observation, reward, and whether the episode is over."""
        self._data.qfrc_applied[:] = np.clip(action, -1.0, 1.0) * self._torque_scale
        mujoco.mj_step(self._model, self._data, self._substeps)
        self._step += 1
        return *self._now(), self._step >= self._imitation.config.horizon
