"""PPO of stable-baselines3 on C MuJoCo, an arm for each core; needs packages that mimic does not: that one, gymnasium.

Loaded where they are installed; see `benchmarks.ppo`.
"""

import os
import time
from collections.abc import Callable
from typing import Any

import gymnasium  # pyright: ignore[reportMissingImports]
import jax
import numpy as np
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize  # pyright: ignore[reportMissingImports]

import mimic
from benchmarks.mujoco_task import MujocoTask
from mimic.trainers.config import PPOConfig

STEPS = 256  # of each arm in a batch: 4096 arms at once, as on a GPU, would be as many processes


class GymnasiumArm(gymnasium.Env):
    """`MujocoTask` as gymnasium has it."""

    def __init__(self, task: MujocoTask, observation_size: int, action_size: int):
        self._task = task
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (observation_size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (action_size,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode."""
        super().reset(seed=seed, options=options)
        return self._task.reset(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step."""
        observation, reward, over = self._task.step(action)
        return observation, reward, over, False, {}


def make_arm(name: str, seed: int) -> Callable[[], GymnasiumArm]:
    """What makes an arm, in a process of its own."""

    def make() -> GymnasiumArm:
        jax.config.update("jax_platforms", "cpu")  # before the backend starts: the accelerator is not for these
        env = mimic.make(name, physics="fused")
        return GymnasiumArm(MujocoTask(env, seed), env.observation_size, env.action_size)

    return make


def learn(name: str, config: PPOConfig, batches: int, stretches: int) -> tuple[int, list[float]]:
    """Environment steps of a stretch of so many batches, and the seconds of each stretch."""
    arms = os.cpu_count() or 1
    workers = SubprocVecEnv([make_arm(name, seed) for seed in range(arms)], start_method="spawn")
    model = PPO(
        "MlpPolicy",
        VecNormalize(workers, norm_reward=False),
        learning_rate=config.learning_rate,  # type: ignore[arg-type]
        n_steps=STEPS,
        batch_size=max(arms * STEPS // config.num_minibatches, 2),  # type: ignore[operator]
        n_epochs=config.num_updates_per_batch,  # type: ignore[arg-type]
        gamma=config.discounting,  # type: ignore[arg-type]
        gae_lambda=config.gae_lambda,
        clip_range=config.clipping_epsilon,
        ent_coef=config.entropy_cost,  # type: ignore[arg-type]
        max_grad_norm=config.max_grad_norm,
        policy_kwargs={"net_arch": list(config.hidden_layers or ())},
        device="cpu",
        seed=0,
    )
    steps, seconds = batches * arms * STEPS, []
    try:
        for _ in range(stretches):
            began = time.perf_counter()
            model.learn(steps, reset_num_timesteps=False)
            seconds.append(time.perf_counter() - began)
    finally:
        workers.close()
    return steps, seconds
