"""Training wrappers: brax's own, with a fresh demonstration for every episode."""

import dataclasses

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper
from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper

from mimic import compat
from mimic.envs.imitation import FIRST_STEP, ArmState, ImitationEnv, arm_state


class FreshEpisodeWrapper(Wrapper):
    """Starts a new episode, on a newly drawn demonstration, wherever one is done.

    Brax's `AutoResetWrapper` returns to the first state that it saw, so that each environment would replay one
    demonstration for the whole run. The first episodes start at random steps of their demonstrations: were all
    environments in step, each batch would hold one part of the motion only.
    """

    def __init__(self, env: Wrapper, imitation: ImitationEnv):
        super().__init__(env)
        self._imitation = imitation

    def reset(self, rng: jax.Array) -> State:
        """Batched reset."""
        state = self.env.reset(rng)
        arm = arm_state(state)
        keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(arm.key, FIRST_STEP)
        steps = jax.vmap(lambda key: jax.random.randint(key, (), 0, self._imitation.config.horizon))(keys)
        arm = dataclasses.replace(arm, step=steps)
        return state.replace(pipeline_state=arm, obs=jax.vmap(self._imitation.observe_home)(arm))

    def step(self, state: State, action: jax.Array) -> State:
        """Batched step."""
        info = state.info
        if "steps" in info:  # brax's EpisodeWrapper counts them
            info = {**info, "steps": jnp.where(state.done, 0, info["steps"])}
        state = state.replace(done=jnp.zeros_like(state.done), info=info)
        state = self.env.step(state, action)
        arm = arm_state(state)
        fresh, fresh_obs = jax.vmap(self._begin)(arm.key)
        done = state.done.astype(bool)

        def where_done(new, old):
            return jnp.where(done.reshape(done.shape + (1,) * (old.ndim - 1)), new, old)

        arm = jax.tree.map(where_done, fresh, arm)
        return state.replace(pipeline_state=arm, obs=where_done(fresh_obs, state.obs))

    def _begin(self, key: jax.Array) -> tuple[ArmState, jax.Array]:
        arm = self._imitation.start(key)
        return arm, self._imitation.observe_home(arm)


def fresh_episodes(env: ImitationEnv) -> Wrapper:
    """Many arms at once, without end; all that `mimic.trainers.ppo.programs` needs."""
    return FreshEpisodeWrapper(VmapWrapper(env), env)


def wrap_for_training(env: Env, episode_length: int, action_repeat: int = 1, randomization_fn=None) -> Wrapper:
    """What `brax.training` is given as `wrap_env_fn`.

    `episode_length` is the horizon, at which the environment itself reports the end; the wrapper's time-out, which PPO
    would treat as a truncation, never comes first.
    """
    imitation = env.unwrapped
    if not isinstance(imitation, ImitationEnv):
        raise TypeError(f"expected an ImitationEnv, got {type(imitation).__name__}")
    if randomization_fn is not None:
        raise ValueError("randomization_fn is not supported")
    compat.mend_brax()  # whose training calls this first
    wrapped = EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat)
    return FreshEpisodeWrapper(wrapped, imitation)
