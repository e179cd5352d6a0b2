"""Training wrappers: brax's own, with a new random demonstration for every episode."""

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper
from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper

from mimic.envs.imitation import FIRST_STEP, ImitationEnv, arm_state


class FreshEpisodeWrapper(Wrapper):
    """Starts a new episode on a random demonstration wherever an episode is done.

    Brax's `AutoResetWrapper` returns to its first state, so that each environment would replay one demonstration for
    the whole run. The first episodes start at random steps of their demonstrations: if all environments were
    synchronous, each batch would contain only one part of the motion.
    """

    def __init__(self, env: Wrapper, imitation: ImitationEnv):
        super().__init__(env)
        self._imitation = imitation

    def reset(self, rng: jax.Array) -> State:
        """Resets all environments of the batch."""
        state = self.env.reset(rng)
        arm = arm_state(state)
        keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(arm.key, FIRST_STEP)
        steps = jax.vmap(lambda key: jax.random.randint(key, (), 0, self._imitation.config.horizon))(keys)
        arm = jax.vmap(self._imitation.at_step)(arm, steps)
        return state.replace(pipeline_state=arm, obs=jax.vmap(self._imitation.observe)(arm))

    def step(self, state: State, action: jax.Array) -> State:
        """Steps all environments of the batch, and restarts those whose episode is done."""
        info = state.info
        if "steps" in info:  # brax's EpisodeWrapper counts them
            info = {**info, "steps": jnp.where(state.done, 0, info["steps"])}
        state = state.replace(done=jnp.zeros_like(state.done), info=info)
        return self._imitation.restart_done(self.env.step(state, action))


def fresh_episodes(env: ImitationEnv) -> Wrapper:
    """A batch of arms that restart when their episode is done, for mimic's own PPO."""
    return FreshEpisodeWrapper(VmapWrapper(env), env)


def wrap_for_training(env: Env, episode_length: int, action_repeat: int = 1, randomization_fn=None) -> Wrapper:
    """Wraps an environment for brax's trainers: the function to pass to them as `wrap_env_fn`.

    Without it, they wrap it with brax's own `AutoResetWrapper`, see `FreshEpisodeWrapper`.
    `episode_length` is the horizon, at which the environment itself terminates the episode. The wrapper's time-out,
    which PPO would treat as a truncation, never comes first.

    Raises:
      TypeError: another environment than those of mimic.
      ValueError: a `randomization_fn`; a `world` has ranges instead.
    """
    imitation = env.unwrapped
    if not isinstance(imitation, ImitationEnv):
        raise TypeError(f"expected an ImitationEnv, got {type(imitation).__name__}")
    if randomization_fn is not None:
        raise ValueError("randomization_fn is not supported")
    wrapped = EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat)
    return FreshEpisodeWrapper(wrapped, imitation)
