"""PPO of stable-baselines3 on C MuJoCo, an arm for each core; that package is not a dependency of mimic."""

import functools
import os
import time

import jax
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize  # pyright: ignore[reportMissingImports]

import mimic
from benchmarks.peers.mujoco_task import MujocoTask
from mimic.trainers.config import PPOConfig

STEPS = 256  # of each arm in a batch; the 4096 arms of a GPU would be 4096 processes


def make_arm(name: str, seed: int) -> MujocoTask:
    jax.config.update("jax_platforms", "cpu")  # before the backend starts: the arms do not use the accelerator
    task = MujocoTask(mimic.make(name, physics="fused"))
    task.reset(seed=seed)
    return task


def learn(name: str, config: PPOConfig, epochs: int) -> tuple[int, list[float]]:
    """Environment steps of an epoch, of one batch, and the times at which the training began and each epoch ended."""
    arms = os.cpu_count() or 1
    workers = SubprocVecEnv([functools.partial(make_arm, name, seed) for seed in range(arms)], start_method="spawn")
    model = PPO(
        "MlpPolicy",
        VecNormalize(workers, norm_reward=False),
        learning_rate=config.learning_rate,
        n_steps=STEPS,
        batch_size=max(arms * STEPS // config.num_minibatches, 2),
        n_epochs=config.num_updates_per_batch,
        gamma=config.discounting,
        gae_lambda=config.gae_lambda,
        clip_range=config.clipping_epsilon,
        ent_coef=config.entropy_cost,
        max_grad_norm=config.max_grad_norm,
        policy_kwargs={"net_arch": list(config.hidden_layers)},
        device="cpu",
        seed=0,
    )
    times = [time.perf_counter()]
    try:
        for _ in range(epochs):
            model.learn(arms * STEPS, reset_num_timesteps=False)
            times.append(time.perf_counter())
    finally:
        workers.close()
    return arms * STEPS, times
