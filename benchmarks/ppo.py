"""Environment steps per second with learning: PPO on our environments and on a stock one.

    python -m benchmarks.ppo --out FILE [--env panda4dof] [--only CASE ...] [--num-envs N]

PPO as `mimic.train` runs it, with the settings of the preset; and brax's own training loop on the same environment, and
on the same task as brax and MuJoCo Playground environments usually implement it. The speed is the median of all epochs
but the first, which compiles, with the quartiles as spread.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from brax.training.agents.ppo import train as brax_ppo
from brax.training.agents.ppo.networks import make_ppo_networks

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect, failure
from benchmarks.common.timing import summary_of_rates
from benchmarks.peers import stock
from mimic.base import compat
from mimic.envs.wrappers import wrap_for_training
from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo.ppo import compile_training

EPOCHS = 6  # the first compiles
SETTINGS = (  # that brax's PPO has under the same names
    "num_envs", "learning_rate", "entropy_cost", "discounting", "unroll_length", "batch_size", "num_minibatches",
    "num_updates_per_batch", "reward_scaling", "clipping_epsilon", "gae_lambda", "max_grad_norm",
)  # fmt: skip
COLUMNS = "env case steps_per_s:,.0f spread:.1% compile_s:.1f"

Case = Callable[[str, PPOConfig, int], dict[str, float]]  # environment, settings, batches of an epoch -> rates


def rates(steps: int, times: Sequence[float]) -> dict[str, float]:
    """Speed from the times at which epochs end, without the first one, and the compilation time of that one."""
    first, *later = np.diff(times).tolist()
    compile_s = round(max(first - float(np.median(later)), 0.0), 3)
    return {"compile_s": compile_s, **summary_of_rates([steps / seconds for seconds in later])}


def settings(config: PPOConfig) -> dict[str, Any]:
    """The settings of a resolved config that all implementations have."""
    return {name: getattr(config, name) for name in SETTINGS}


def mimic_loop(physics: str, name: str, config: PPOConfig, batches: int) -> dict[str, float]:
    env = mimic.make(name, physics=physics)
    times = [time.perf_counter()]
    start, _, epoch = compile_training(env, config, batches)
    state = start(0)
    for _ in range(EPOCHS):
        state, metrics = epoch()(state)
        jax.block_until_ready(metrics)
        times.append(time.perf_counter())
    return rates(batches * config.steps_per_batch, times)


def brax_loop(physics: str, name: str, config: PPOConfig, batches: int) -> dict[str, float]:
    """Brax's own training loop, on the environment, or with "stock" on the stock one."""
    compat.mend_brax()
    imitation = mimic.make(name, physics="mjx" if physics == "stock" else physics)
    env, wrap = (stock.StockEnv(imitation), stock.wrap) if physics == "stock" else (imitation, wrap_for_training)
    hidden = {f"{network}_hidden_layer_sizes": tuple(config.hidden_layers) for network in ("policy", "value")}
    times = [time.perf_counter()]
    brax_ppo.train(
        environment=env,
        num_timesteps=EPOCHS * batches * config.steps_per_batch,
        episode_length=imitation.config.horizon + 1,
        wrap_env_fn=wrap,
        num_eval_envs=1,
        num_evals=EPOCHS + 1,
        run_evals=False,
        normalize_observations=True,
        progress_fn=lambda *_: times.append(time.perf_counter()),
        network_factory=partial(make_ppo_networks, **hidden),
        **settings(config),
    )
    return rates(batches * config.steps_per_batch, times)


CASES: dict[str, Case] = {
    "mimic, fused": partial(mimic_loop, "fused"),
    "mimic, mjx": partial(mimic_loop, "mjx"),
    "brax's loop, fused": partial(brax_loop, "fused"),
    "brax's loop, mjx.Data carried": partial(brax_loop, "stock"),
}


def run(name: str, config: PPOConfig, case: str, batches: int) -> Row:
    row: Row = {"env": name, "case": case}
    began = time.perf_counter()
    try:
        row |= CASES[case](name, config, batches)
    except Exception as error:  # out of memory
        row |= failure(error)
    return {**row, "wall_s": round(time.perf_counter() - began, 1)}


def main() -> None:
    numbers: Any = {"num_envs": int, "batch_size": int, "batches": int}  # default: of the preset
    options = make_parser("ppo", __doc__, env="panda4dof", only=CASES, **numbers).parse_args()
    config = PPOConfig(num_envs=options.num_envs, batch_size=options.batch_size)
    config = config.resolve(jax.default_backend(), jax.device_count())
    batches = options.batches or (10 if jax.default_backend() == "gpu" else 1)
    rows = (run(options.env, config, case, batches) for case in options.only)
    collect(options, rows, "rows", COLUMNS, settings=settings(config), layers=config.hidden_layers)


if __name__ == "__main__":
    main()
