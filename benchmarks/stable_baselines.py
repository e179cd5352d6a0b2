"""PPO of stable-baselines3 with its default settings on the tasks of mimic's runs, and the gaps of both.

    python -m benchmarks.stable_baselines --out FILE --runs RUN [RUN ...] [--steps 3000000] [--jobs N]

RUN is a run directory of `python -m mimic.train`. Environment, motions, discount factor and seed are those of the run;
everything else is what the package sets, as for the paper, which states no more. A batch has its 2,048 steps, of 64
arms. The package is not a dependency of mimic: `pip install stable-baselines3`. It trains on one core a run.
"""

import functools
import json
import multiprocessing
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
from brax.envs.base import State

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect
from mimic.evaluation.evaluator import Controller, Evaluator
from mimic.runs.files import REPORT
from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo.trainer import run_environment
from mimic.trainers.run_config import load_config

ARMS, BATCH = 64, 2048
COLUMNS = "env demonstrations seed steps:,.0f steps_per_s:,.0f gap[train]:.2% gap[held_out]:.2% mimic[held_out]:.2%"


def mean_action(weights: dict[str, Any]) -> Controller:
    """The deterministic policy of the package's default network, two layers of tanh."""

    def controller(state: State) -> jax.Array:
        x = jnp.asarray(state.obs)
        for layer in ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2"):
            x = jnp.tanh(weights[f"{layer}.weight"] @ x + weights[f"{layer}.bias"])
        return weights["action_net.weight"] @ x + weights["action_net.bias"]

    return controller


def learn(run: Path, steps: int) -> Row:
    """Trains and evaluates the package on the task of a run."""
    jax.config.update("jax_platforms", "cpu")
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]

    from examples.stable_baselines3_env import Arms
    from mimic.gymnasium import VectorEnv

    torch.set_num_threads(1)
    config, report = load_config(run), json.loads((run / REPORT).read_text())
    env, held_out = run_environment(config.env, run)
    options = {
        "n_steps": BATCH // ARMS,
        "gamma": cast(PPOConfig, config.trainer).discounting,
        "seed": config.seed,
        "device": "cpu",
    }
    began = time.perf_counter()
    model = PPO("MlpPolicy", Arms(VectorEnv(env, num_envs=ARMS)), **options).learn(steps)
    rate = model.num_timesteps / (time.perf_counter() - began)
    weights = {name: jnp.asarray(value.numpy()) for name, value in model.policy.state_dict().items()}
    evaluator = Evaluator(env, held_out)
    summary = evaluator.summary(jax.jit(lambda: evaluator.rollout(mean_action(weights)))())
    task = {"env": config.env.name, "demonstrations": env.demonstrations.count, "seed": config.seed}
    speed = {"steps": model.num_timesteps, "steps_per_s": round(rate)}
    return {**task, **speed, "gap": summary["optimality_gap"], "mimic": report["optimality_gap"]}


def main() -> None:
    parser = make_parser("stable_baselines", __doc__, steps=3_000_000, jobs=os.cpu_count() or 1)
    parser.add_argument("--runs", nargs="+", type=Path, required=True, metavar="RUN")
    options = parser.parse_args()

    def rows() -> Iterator[Row]:
        with multiprocessing.get_context("spawn").Pool(min(options.jobs, len(options.runs))) as pool:
            yield from pool.imap(functools.partial(learn, steps=options.steps), options.runs)

    collect(options, rows(), "rows", COLUMNS)


if __name__ == "__main__":
    main()
