"""PPO of stable-baselines3 with its default settings in the paper's setting.

    python -m benchmarks.stable_baselines --out FILE [--tasks NAME ...] [--steps 1000000] [--jobs N]

The tasks are the cases `paper_setting` of `benchmarks.study`: their environments, motions, discount factors and seeds.
Everything else is what the package sets, as for the paper, which states no more. A batch has its 2,048 steps, of 64
arms. The package is not a dependency of mimic: `pip install stable-baselines3`. It trains on one core a run.
"""

import functools
import multiprocessing
import os
import re
import time
from collections.abc import Iterator
from typing import Any, cast

import jax
import jax.numpy as jnp
from brax.envs.base import State
from omegaconf import OmegaConf

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect
from benchmarks.study import cases
from mimic.envs.make import make
from mimic.evaluation.evaluator import Controller, Evaluator

ARMS, BATCH = 64, 2048
COLUMNS = "task env demonstrations seed steps:,.0f steps_per_s:,.0f gap[train]:.2% gap[held_out]:.2%"
TASKS = {case.name.removesuffix("-paper"): case for case in cases("paper") if case.group == "paper_setting"}


def mean_action(weights: dict[str, Any]) -> Controller:
    """The deterministic policy of the package's default network, two layers of tanh."""

    def controller(state: State) -> jax.Array:
        x = jnp.asarray(state.obs)
        for layer in ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2"):
            x = jnp.tanh(weights[f"{layer}.weight"] @ x + weights[f"{layer}.bias"])
        return weights["action_net.weight"] @ x + weights["action_net.bias"]

    return controller


def learn(run: tuple[str, int], steps: int) -> Row:
    """Trains and evaluates the package on a task, with a seed."""
    jax.config.update("jax_platforms", "cpu")
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]

    from examples.stable_baselines3_env import Arms
    from mimic.gymnasium import VectorEnv

    torch.set_num_threads(1)
    task, seed = run
    settings = OmegaConf.from_dotlist([re.sub("^env=", "env.name=", argument) for argument in TASKS[task].arguments])
    fields = cast(dict[str, Any], OmegaConf.to_container(settings.env))
    env = make(fields.pop("name"), metric=settings.metric, **fields)
    assert env.held_out is not None
    options = {
        "n_steps": BATCH // ARMS,
        "gamma": settings.trainer.discounting,
        "seed": seed,
        "device": "cpu",
    }
    began = time.perf_counter()
    model = PPO("MlpPolicy", Arms(VectorEnv(env, num_envs=ARMS)), **options).learn(steps)
    rate = model.num_timesteps / (time.perf_counter() - began)
    weights = {name: jnp.asarray(value.numpy()) for name, value in model.policy.state_dict().items()}
    evaluator = Evaluator(env, env.held_out)
    summary = evaluator.summary(jax.jit(lambda: evaluator.rollout(mean_action(weights)))())
    named = {"task": task, "env": env.config.name, "demonstrations": env.demonstrations.count, "seed": seed}
    return {**named, "steps": model.num_timesteps, "steps_per_s": round(rate), "gap": summary["optimality_gap"]}


def main() -> None:
    parser = make_parser("stable_baselines", __doc__, tasks=TASKS, steps=1_000_000, jobs=os.cpu_count() or 1)
    options = parser.parse_args()
    runs = [(task, seed) for seed in range(TASKS[options.tasks[0]].seeds) for task in options.tasks]

    def rows() -> Iterator[Row]:
        with multiprocessing.get_context("spawn").Pool(min(options.jobs, len(runs))) as pool:
            yield from pool.imap(functools.partial(learn, steps=options.steps), runs)

    collect(options, rows(), "rows", COLUMNS)


if __name__ == "__main__":
    main()
