"""Many arms as an environment of Stable-Baselines3, which comes apart: `pip install stable-baselines3`."""

import numpy as np
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

from mimic.gymnasium import VectorEnv


class Arms(VecEnv):
    """Many arms for Stable-Baselines3."""

    def __init__(self, arms: VectorEnv):
        self.arms, self.actions = arms, None
        super().__init__(arms.num_envs, arms.single_observation_space, arms.single_action_space)

    def reset(self):
        seed = self._seeds[0]
        self._reset_seeds()
        return self.arms.reset(seed=seed)[0]

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        observations, rewards, ended, _, infos = self.arms.step(self.actions)
        by_arm = [{} for _ in range(self.num_envs)]
        for arm in np.flatnonzero(ended):  # the observation before the restart; an episode is never truncated
            by_arm[arm] = {"terminal_observation": infos["final_obs"][arm], "TimeLimit.truncated": False}
        return observations, rewards.astype(np.float32), ended, by_arm

    def close(self):
        self.arms.close()

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.arms, attr_name)] * len(self._get_indices(indices))

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError("the arms have no attributes of their own")

    def env_method(self, method_name, *args, indices=None, **kwargs):
        raise NotImplementedError("the arms have no methods of their own")

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * len(self._get_indices(indices))
