"""The environments for Gymnasium: `VectorEnv` simulates thousands of arms in parallel, `Env` one arm.

Importing this module registers them with Gymnasium, as `gymnasium.make("mimic/panda4dof-v0")` and
`gymnasium.make_vec("mimic/panda4dof-v0", num_envs=512)`. `gymnasium.make("mimic.gymnasium:mimic/...")` needs no import.
"""

import mimic.base.quiet_mjx  # noqa: F401  # before brax

# isort: split
from typing import Any, cast

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from mimic.arms.rendering import ArmScene
from mimic.base.config import check_choice
from mimic.envs import env_config, environments
from mimic.envs.imitation import ArmState, ImitationEnv
from mimic.envs.make import make_env

RENDER_MODES = ("rgb_array",)


class VectorEnv(gymnasium.vector.VectorEnv):
    """Many arms in parallel on JAX's default device; actions and observations are NumPy arrays.

    When an episode ends, the same step returns the first observation of the next episode, on a random demonstration;
    the last observation of the ended one is `infos["final_obs"]` (Gymnasium's `AutoresetMode.SAME_STEP`). Episodes are
    only terminated, never truncated: after the horizon there is nothing to imitate. `infos` has the metrics of the
    environment, each [num_envs].

    Args:
      env: name of an environment, or an `ImitationEnv`.
      num_envs: number of arms.
      render_mode: "rgb_array", or None.
      overrides: fields of a named environment's config, see `mimic.env_config`.

    Raises:
      ValueError: an unknown name, field or render mode, or fewer than one arm.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10, "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self, env: str | ImitationEnv = "panda4dof", num_envs: int = 1, render_mode: str | None = None, **overrides: Any
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs: expected at least 1, got {num_envs}")
        self.imitation = _imitation_env(env, overrides)
        self.metadata = {**self.metadata, "render_fps": _frames_per_second(self.imitation)}
        self.num_envs, self.render_mode = num_envs, _checked_render_mode(render_mode)
        self.single_observation_space, self.single_action_space = _spaces(self.imitation)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._renderer = _Renderer(self.imitation)
        self._begin = jax.jit(jax.vmap(lambda key: self.imitation.begin(self.imitation.start(key))))
        self._advance = jax.jit(self._step_and_restart)
        self._state: State | None = None

    def _step_and_restart(self, state: State, action: jax.Array) -> tuple[State, jax.Array]:
        """States after a step, where episodes that are done have restarted, and the observations before the restart."""
        stepped = jax.vmap(self.imitation.step)(state, action)
        return self.imitation.restart_done(stepped), cast(jax.Array, stepped.obs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode of each arm, on a random demonstration.

        Returns:
          Observations [num_envs, n], and an empty dict.
        """
        super().reset(seed=seed)
        del options
        state = self._begin(jax.random.split(_key(self.np_random), self.num_envs))
        self._state = state
        return np.array(state.obs), {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances each arm by one control step.

        Args:
          actions: [num_envs, numbers] in [-1, 1]: torques, or what `env.control` says.

        Returns:
          Observations, rewards, terminations, truncations (all False), and infos.

        Raises:
          ValueError: actions of the wrong shape, or `reset` was not called.
        """
        state, last_obs = self._advance(_require_reset(self._state), _checked_action(actions, self.action_space))
        self._state = state
        done = np.array(state.done, bool)
        everywhere = np.ones(self.num_envs, bool)
        infos: dict[str, Any] = {}
        for name, values in state.metrics.items():
            infos |= {name: np.array(values), f"_{name}": everywhere}
        if done.any():
            infos |= {"final_obs": np.array(last_obs), "_final_obs": done.copy()}
        return np.array(state.obs), np.array(state.reward, float), done, np.zeros_like(done), infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """An image of each arm next to its expert; None without a render mode."""
        if self.render_mode is None:
            return None
        arms: ArmState = jax.device_get(_require_reset(self._state).pipeline_state)
        return tuple(self._renderer.of(jax.tree.map(lambda leaf, i=i: leaf[i], arms)) for i in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Closes the renderer."""
        del kwargs
        self._renderer.close()


class Env(gymnasium.Env):
    """One arm. For many arms, one `VectorEnv` is far faster than copies of this class.

    Args:
      env: name of an environment, or an `ImitationEnv`.
      render_mode: "rgb_array", or None.
      overrides: fields of a named environment's config, see `mimic.env_config`.

    Raises:
      ValueError: an unknown name, field or render mode.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}

    def __init__(self, env: str | ImitationEnv = "panda4dof", render_mode: str | None = None, **overrides: Any):
        self.imitation = _imitation_env(env, overrides)
        self.metadata = {**self.metadata, "render_fps": _frames_per_second(self.imitation)}
        self.render_mode = _checked_render_mode(render_mode)
        self.observation_space, self.action_space = _spaces(self.imitation)
        self._renderer = _Renderer(self.imitation)
        self._begin, self._advance = jax.jit(self._start), jax.jit(self.imitation.step)
        self._state: State | None = None

    def _start(self, key: jax.Array, demonstration: jax.Array) -> State:
        """Starts an episode on a demonstration, or on a random one where its index is negative."""
        key_demonstration, key_start = jax.random.split(key)
        random = jax.random.randint(key_demonstration, (), 0, self.imitation.demonstrations.count)
        demonstration = jnp.where(demonstration < 0, random, demonstration)
        return self.imitation.begin(self.imitation.start(key_start, demonstration))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
          seed: random seed of this and all following episodes.
          options: `{"demonstration": i}` for demonstration i; otherwise the demonstration is random.

        Raises:
          ValueError: no such demonstration.
        """
        super().reset(seed=seed)
        demonstration, count = (options or {}).get("demonstration"), self.imitation.demonstrations.count
        if demonstration is not None and not 0 <= demonstration < count:
            raise ValueError(f"demonstration: expected a number from 0 to {count - 1}, got {demonstration}")
        state = self._begin(_key(self.np_random), -1 if demonstration is None else int(demonstration))
        self._state = state
        return np.array(state.obs), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advances the arm by one control step.

        Args:
          action: [numbers] in [-1, 1]: torques, or what `env.control` says.

        Returns:
          Observation, reward, terminated, truncated (always False), and the metrics of the environment.

        Raises:
          ValueError: an action of the wrong shape, or `reset` was not called.
        """
        state = self._advance(_require_reset(self._state), _checked_action(action, self.action_space))
        self._state = state
        infos = {name: float(value) for name, value in state.metrics.items()}
        return np.array(state.obs), float(state.reward), bool(state.done), False, infos

    def render(self) -> np.ndarray | None:
        """An image of the arm next to its expert; None without a render mode."""
        if self.render_mode is None:
            return None
        return self._renderer.of(jax.device_get(_require_reset(self._state).pipeline_state))

    def close(self) -> None:
        """Closes the renderer."""
        self._renderer.close()


class _Renderer:
    """Images of expert and learner. The first image starts OpenGL."""

    def __init__(self, env: ImitationEnv):
        self._env = env
        self._scene: ArmScene | None = None

    def of(self, state: Any) -> np.ndarray:
        """The learner next to its expert."""
        env = self._env
        if self._scene is None:
            match = env.config.metric.match_links(env.expert, env.learner)
            colours = [match.expert_colours, match.learner_colours]
            arms = [env.config.expert, env.config.learner]
            self._scene = ArmScene(arms, limits=env.config.limits, fast=True, colours=colours)
        sample = min(int(state.step), env.demonstrations.horizon)
        return self._scene.image([env.demonstrations.qpos[int(state.demonstration), sample], state.qpos])

    def close(self) -> None:
        if self._scene is not None:
            self._scene.__exit__()
            self._scene = None


def _imitation_env(env: str | ImitationEnv, overrides: dict[str, Any]) -> ImitationEnv:
    if isinstance(env, str):
        config = env_config(env, **overrides)
        if config.kind == "sampled_arms":
            raise ValueError(
                f"env: expected an environment of one learner, got {env!r}, which draws a learner for each episode"
            )
        return make_env(config)
    if overrides:
        raise ValueError(f"{next(iter(overrides))}: expected the name of an environment with it, got an ImitationEnv")
    return env


def _frames_per_second(env: ImitationEnv) -> int:
    return max(round(1 / env.config.control_dt), 1)


def _checked_render_mode(render_mode: str | None) -> str | None:
    if render_mode is not None:
        check_choice("render_mode", render_mode, RENDER_MODES)
    return render_mode


def _spaces(env: ImitationEnv) -> tuple[spaces.Box, spaces.Box]:
    """The observation space and the action space."""
    return (
        spaces.Box(-np.inf, np.inf, (env.observation_size,), np.float32),
        spaces.Box(-1.0, 1.0, (env.action_size,), np.float32),
    )


def _key(random: np.random.Generator) -> jax.Array:
    return jax.random.PRNGKey(int(random.integers(2**31)))


def _require_reset(state: State | None) -> State:
    if state is None:
        raise ValueError("expected a call of reset before step and render")
    return state


def _checked_action(action: Any, space: spaces.Space) -> np.ndarray:
    values = np.asarray(action, np.float32)
    if values.shape != space.shape:
        raise ValueError(f"action: expected shape {space.shape}, got {values.shape}")
    return values


def _register() -> None:
    for name in environments():
        gymnasium.register(
            f"mimic/{name}-v0",
            entry_point="mimic.gymnasium:Env",
            vector_entry_point="mimic.gymnasium:VectorEnv",
            kwargs={"env": name},
        )


_register()
