"""The environments as Gymnasium knows them: `VectorEnv`, thousands of arms at once, and `Env`, one arm.

Importing this module registers them, which is how Gymnasium finds them: `gymnasium.make("mimic/panda4dof-v0")` and
`gymnasium.make_vec("mimic/panda4dof-v0", num_envs=512)`, or in one go `gymnasium.make("mimic.gymnasium:mimic/...")`.
"""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from mimic import compat
from mimic.arms.rendering import ArmScene
from mimic.config import check_choice
from mimic.envs import environments, make

compat.import_mjx()  # quietly; brax would import it too

from brax.envs.base import State  # noqa: E402

from mimic.envs.imitation import ArmState, ImitationEnv, arm_state  # noqa: E402

RENDER_MODES = ("rgb_array",)


class VectorEnv(gymnasium.vector.VectorEnv):
    """Many arms at once, on the device that JAX has found; NumPy goes in and comes out.

    Where an episode ends, the same step gives the first observation of the next one, on a newly drawn demonstration;
    the last observation is `infos["final_obs"]` (Gymnasium's `AutoresetMode.SAME_STEP`). All ends are terminations:
    after the horizon there is nothing to imitate. `infos` has the metrics of the environment, each [num_envs].

    Args:
      env: name of an environment, or one that is made.
      num_envs: arms at once.
      render_mode: "rgb_array", or None.
      overrides: of a named environment, see `mimic.env_config`; `physics="fused"` is the fast one.

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
        self._picture = _Picture(self.imitation)
        self._begin = jax.jit(jax.vmap(lambda key: self.imitation.begin(self.imitation.start(key))))
        self._advance = jax.jit(self._step_and_restart)
        self._state: State | None = None

    def _step_and_restart(self, state: State, action: jax.Array) -> tuple[State, jax.Array]:
        """The step with new episodes where old ones ended, and the observations before that."""
        stepped = jax.vmap(self.imitation.step)(state, action)
        arms = arm_state(stepped)
        fresh = jax.vmap(self.imitation.start)(arms.key)
        fresh_obs = jax.vmap(self.imitation.observe_home)(fresh)
        done = stepped.done.astype(bool)

        def where_done(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(done.reshape(done.shape + (1,) * (old.ndim - 1)), new, old)

        arms = jax.tree.map(where_done, fresh, arms)
        obs: jax.Array = stepped.obs  # type: ignore[assignment]
        return stepped.replace(pipeline_state=arms, obs=where_done(fresh_obs, obs)), obs

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode in each arm, on a random demonstration."""
        super().reset(seed=seed)
        del options
        state = self._begin(jax.random.split(_key(self.np_random), self.num_envs))
        self._state = state
        return np.array(state.obs), {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Holds a torque for one control step in each arm.

        Raises:
          ValueError: actions of the wrong shape, or no `reset` before.
        """
        state, last_obs = self._advance(_begun(self._state), _checked_action(actions, self.action_space))
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
        """A picture of each arm beside its expert; None without a render mode."""
        if self.render_mode is None:
            return None
        arms: ArmState = jax.device_get(_begun(self._state).pipeline_state)
        return tuple(self._picture.of(jax.tree.map(lambda leaf, i=i: leaf[i], arms)) for i in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Gives the renderer back."""
        del kwargs
        self._picture.close()


class Env(gymnasium.Env):
    """One arm. For many, `VectorEnv` is as fast as the hardware allows, and copies of this one are not.

    Args:
      env: name of an environment, or one that is made.
      render_mode: "rgb_array", or None.
      overrides: of a named environment, see `mimic.env_config`.

    Raises:
      ValueError: an unknown name, field or render mode.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}

    def __init__(self, env: str | ImitationEnv = "panda4dof", render_mode: str | None = None, **overrides: Any):
        self.imitation = _imitation_env(env, overrides)
        self.metadata = {**self.metadata, "render_fps": _frames_per_second(self.imitation)}
        self.render_mode = _checked_render_mode(render_mode)
        self.observation_space, self.action_space = _spaces(self.imitation)
        self._picture = _Picture(self.imitation)
        self._begin, self._advance = jax.jit(self._start), jax.jit(self.imitation.step)
        self._state: State | None = None

    def _start(self, key: jax.Array, demonstration: jax.Array) -> State:
        key_choice, key_start = jax.random.split(key)
        random = jax.random.randint(key_choice, (), 0, self.imitation.demonstrations.count)
        chosen = jnp.where(demonstration < 0, random, demonstration)
        return self.imitation.begin(self.imitation.start(key_start, chosen))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode.

        Args:
          seed: of all randomness from here on.
          options: `{"demonstration": i}` for a certain one; a random one otherwise.

        Raises:
          ValueError: no such demonstration.
        """
        super().reset(seed=seed)
        chosen, count = (options or {}).get("demonstration"), self.imitation.demonstrations.count
        if chosen is not None and not 0 <= chosen < count:
            raise ValueError(f"demonstration: expected a number from 0 to {count - 1}, got {chosen}")
        state = self._begin(_key(self.np_random), -1 if chosen is None else int(chosen))
        self._state = state
        return np.array(state.obs), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Holds a torque for one control step.

        Raises:
          ValueError: an action of the wrong shape, or no `reset` before.
        """
        state = self._advance(_begun(self._state), _checked_action(action, self.action_space))
        self._state = state
        infos = {name: float(value) for name, value in state.metrics.items()}
        return np.array(state.obs), float(state.reward), bool(state.done), False, infos

    def render(self) -> np.ndarray | None:
        """A picture of the arm beside its expert; None without a render mode."""
        if self.render_mode is None:
            return None
        return self._picture.of(jax.device_get(_begun(self._state).pipeline_state))

    def close(self) -> None:
        """Gives the renderer back."""
        self._picture.close()


class _Picture:
    """Pictures of expert and learner; OpenGL is started by the first one."""

    def __init__(self, env: ImitationEnv):
        self._env = env
        self._scene: ArmScene | None = None

    def of(self, state: Any) -> np.ndarray:
        """One arm beside its expert."""
        env = self._env
        if self._scene is None:
            self._scene = ArmScene([env.config.expert, env.config.learner], limits=env.config.limits)
        sample = min(int(state.step), env.demonstrations.horizon)
        return self._scene.image([env.demonstrations.qpos[int(state.demonstration), sample], state.qpos])

    def close(self) -> None:
        if self._scene is not None:
            self._scene.__exit__()
            self._scene = None


def _imitation_env(env: str | ImitationEnv, overrides: dict[str, Any]) -> ImitationEnv:
    if isinstance(env, str):
        return make(env, **overrides)
    if overrides:
        raise ValueError(f"{next(iter(overrides))}: expected the name of an environment with it, got one that is made")
    return env


def _frames_per_second(env: ImitationEnv) -> int:
    return max(round(1 / env.config.control_dt), 1)


def _checked_render_mode(render_mode: str | None) -> str | None:
    if render_mode is not None:
        check_choice("render_mode", render_mode, RENDER_MODES)
    return render_mode


def _spaces(env: ImitationEnv) -> tuple[spaces.Box, spaces.Box]:
    """Of observations and of actions."""
    return (
        spaces.Box(-np.inf, np.inf, (env.observation_size,), np.float32),
        spaces.Box(-1.0, 1.0, (env.action_size,), np.float32),
    )


def _key(random: np.random.Generator) -> jax.Array:
    return jax.random.PRNGKey(int(random.integers(2**31)))


def _begun(state: State | None) -> State:
    if state is None:
        raise ValueError("expected reset before step and render")
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
