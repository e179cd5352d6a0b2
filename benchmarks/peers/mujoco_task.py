"""The task on C MuJoCo, one arm at a time, as it was before there was physics on accelerators."""

import dataclasses
from typing import Any

import gymnasium
import jax
import mujoco
import numpy as np

from benchmarks.peers.stock import model_with_substeps
from mimic.envs.imitation import ImitationEnv


class MujocoTask(gymnasium.Env):
    """Steps one arm; reward and observation are those of the imitation environment, compiled for the CPU."""

    def __init__(self, imitation: ImitationEnv):
        self._imitation = imitation
        self._model = model_with_substeps(imitation)
        self._data = mujoco.MjData(self._model)
        self._torque_scale, self._home = np.asarray(imitation.torque_scale, float), np.asarray(imitation.learner.home)
        self._state = jax.device_get(dataclasses.replace(imitation.start(jax.random.PRNGKey(0)), load=None))
        distance = lambda arm: imitation.distance(arm.qpos, arm.qvel, arm.demonstration, arm.step)  # noqa: E731
        self._look = jax.jit(lambda arm: (imitation.observe(arm), -distance(arm)))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (imitation.observation_size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (imitation.action_size,), np.float32)

    def _advanced(self, **changes: int) -> tuple[np.ndarray, float]:
        """Observation and reward of MuJoCo's state, with a new step or demonstration."""
        joints = {"qpos": self._data.qpos.astype(np.float32), "qvel": self._data.qvel.astype(np.float32)}
        numbers = {name: np.int32(value) for name, value in changes.items()}
        self._state = dataclasses.replace(self._state, **joints, **numbers)  # type: ignore[arg-type]
        with jax.default_device(jax.local_devices(backend="cpu")[0]):
            observation, reward = jax.device_get(self._look(self._state))
        return observation, float(reward)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """At rest in the home pose, on the demonstration of `options`, or a random one."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = self._home
        random = int(self.np_random.integers(self._imitation.demonstrations.count))
        return self._advanced(step=0, demonstration=(options or {}).get("demonstration", random))[0], {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        self._data.qfrc_applied[:] = np.clip(action, -1.0, 1.0) * self._torque_scale
        mujoco.mj_step(self._model, self._data, self._imitation.config.substeps)
        step = int(self._state.step) + 1
        return *self._advanced(step=step), step >= self._imitation.config.horizon, False, {}
