"""Environment steps per second with learning: PPO on our environments, on a stock one, and as the paper had it.

    python -m benchmarks.ppo --out FILE [--env panda4dof] [--only CASE ...] [--num-envs N]

PPO as `mimic.train` runs it, with the settings of the preset, on the environment with the physics `fused` and `mjx`;
brax's own training loop on the same environment, and on the same task as brax and MuJoCo Playground environments
usually have it: `mjx.Data` carried, brax's own wrappers. Beside them PPO of stable-baselines3 on C MuJoCo on the
processor, where it is installed: the same networks and as many minibatches and passes, with an arm for each core. A
training goes on for some stretches; the speed is the median of all but the first, which compiles, with the quartiles as
spread.
"""

import argparse
import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import optax  # noqa: E402
from brax.envs.base import Env  # noqa: E402
from brax.training.agents.ppo import train as brax_ppo  # noqa: E402
from brax.training.agents.ppo.networks import make_ppo_networks  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

import mimic  # noqa: E402
from benchmarks import stock  # noqa: E402
from benchmarks.record import write_results  # noqa: E402
from mimic import compat  # noqa: E402
from mimic.envs.imitation import ImitationEnv  # noqa: E402
from mimic.envs.wrappers import wrap_for_training  # noqa: E402
from mimic.trainers.config import PPOConfig, PPOSettings  # noqa: E402
from mimic.trainers.ppo import training  # noqa: E402
from mimic.trainers.ppo.programs import compile_training  # noqa: E402

ON_PROCESSOR = "stable-baselines3, C MuJoCo"
_STRETCHES = 6  # the first compiles

Case = Callable[[str, PPOSettings, int], dict[str, float]]


def rates(steps: int, seconds: Sequence[float]) -> dict[str, float]:
    """Speed of stretches of as many steps: median and spread (quartiles) without the first, and what that compiled."""
    later = np.asarray(seconds[1:])
    low, median, high = np.quantile(steps / later, [0.25, 0.5, 0.75])
    return {
        "compile_s": round(max(seconds[0] - float(np.median(later)), 0.0), 3),
        "steps_per_s": float(median),
        "spread": round(float((high - low) / median), 4),
    }


def learn(env: ImitationEnv, config: PPOSettings, batches: int) -> dict[str, float]:
    """PPO as `mimic.train` runs it, in stretches of so many batches."""
    networks = training.make_networks(config, env.observation_size, env.action_size)
    schedule = optax.constant_schedule(config.learning_rate)
    seconds: list[float] = []
    began = time.perf_counter()
    begin, program = compile_training(env, config, networks, batches, schedule, None)
    learning = begin()(0)
    for _ in range(_STRETCHES):
        learning, metrics = program()(learning)
        jax.block_until_ready(metrics)
        seconds.append(time.perf_counter() - began)
        began = time.perf_counter()
    return rates(batches * config.steps_per_batch, seconds)


def learn_by_brax(
    env: Env, wrap: Callable[..., Env], horizon: int, config: PPOSettings, batches: int
) -> dict[str, float]:
    """Brax's own training loop, in stretches of so many batches."""
    compat.mend_brax()
    seconds: list[float] = []
    steps = batches * config.steps_per_batch
    began = [time.perf_counter()]

    def on_stretch(*_: Any) -> None:
        seconds.append(time.perf_counter() - began[0])
        began[0] = time.perf_counter()

    brax_ppo.train(
        environment=env,
        num_timesteps=_STRETCHES * steps,
        episode_length=horizon + 1,
        wrap_env_fn=wrap,
        num_eval_envs=1,
        num_evals=_STRETCHES + 1,
        run_evals=False,
        normalize_observations=True,
        progress_fn=on_stretch,
        network_factory=_brax_networks(config),
        **settings(config),
    )
    return rates(steps, seconds)


def settings(config: PPOSettings) -> dict[str, Any]:
    """Of a resolved config, under brax's names."""
    return {
        "num_envs": config.num_envs,
        "learning_rate": config.learning_rate,
        "entropy_cost": config.entropy_cost,
        "discounting": config.discounting,
        "unroll_length": config.unroll_length,
        "batch_size": config.batch_size,
        "num_minibatches": config.num_minibatches,
        "num_updates_per_batch": config.num_updates_per_batch,
        "reward_scaling": config.reward_scaling,
        "clipping_epsilon": config.clipping_epsilon,
        "gae_lambda": config.gae_lambda,
        "max_grad_norm": config.max_grad_norm,
    }


def _brax_networks(config: PPOSettings) -> Callable[..., Any]:
    hidden = tuple(config.hidden_layers or ())
    return functools.partial(make_ppo_networks, policy_hidden_layer_sizes=hidden, value_hidden_layer_sizes=hidden)


def own(physics: str) -> Case:
    return lambda name, config, batches: learn(mimic.make(name, physics=physics), config, batches)


def in_brax_loop(name: str, config: PPOSettings, batches: int) -> dict[str, float]:
    env = mimic.make(name, physics="fused")
    return learn_by_brax(env, wrap_for_training, env.config.horizon, config, batches)


def carried(name: str, config: PPOSettings, batches: int) -> dict[str, float]:
    env = mimic.make(name, physics="mjx")
    return learn_by_brax(stock.StockEnv(env), stock.wrap, env.config.horizon, config, batches)


def one_at_a_time(name: str, config: PPOSettings, batches: int) -> dict[str, float]:
    from benchmarks import baselines  # needs packages that mimic does not

    return rates(*baselines.learn(name, config, batches, _STRETCHES))


CASES: dict[str, Case] = {
    "mimic, fused": own("fused"),
    "mimic, mjx": own("mjx"),
    "brax's loop, fused": in_brax_loop,
    "brax's loop, mjx.Data carried": carried,
    ON_PROCESSOR: one_at_a_time,
}


def run(name: str, config: PPOSettings, cases: Sequence[str], batches: int) -> list[dict[str, Any]]:
    """A row for each case; what cannot run is a row that says why."""
    rows = []
    for case in cases:
        row: dict[str, Any] = {"env": name, "case": case}
        began = time.perf_counter()
        try:
            row |= CASES[case](name, config, 1 if case == ON_PROCESSOR else batches)
        except Exception as error:  # not installed, or out of memory: the others go on
            row["failed"] = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"[:200]
        rows.append({**row, "wall_s": round(time.perf_counter() - began, 1)})
    return rows


def table(rows: Sequence[dict[str, Any]]) -> Table:
    """Speeds, and how many times as fast as the slowest."""
    slowest = min((row["steps_per_s"] for row in rows if "failed" not in row), default=1.0)
    shown = Table("env", "PPO on", "env steps/s", "spread", "compile [s]", "times")
    for row in rows:
        if "failed" in row:
            shown.add_row(row["env"], row["case"], row["failed"][:60])
            continue
        rate = row["steps_per_s"]
        figures = f"{rate:,.0f}", f"{row['spread']:.1%}", f"{row['compile_s']:.1f}", f"{rate / slowest:,.1f}"
        shown.add_row(row["env"], row["case"], *figures)
    return shown


def draw(rows: Sequence[dict[str, Any]], out: Path) -> None:
    """A bar for each case."""
    found = [row for row in rows if "failed" not in row]
    figure, axes = plt.subplots(figsize=(7, 1 + 0.5 * max(len(found), 1)), layout="constrained")
    values = [row["steps_per_s"] for row in found]
    errors = [0.5 * row["spread"] * row["steps_per_s"] for row in found]
    bars = axes.barh([row["case"] for row in found], values, xerr=errors, color="C0")
    axes.bar_label(bars, [f"{value:,.0f}" for value in values], padding=4, fontsize="small")
    axes.set(xscale="log", xlabel="environment steps/s, with learning", title=rows[0]["env"])
    axes.invert_yaxis()
    axes.margins(x=0.15)
    figure.savefig(out, dpi=150)
    plt.close(figure)


def main() -> None:
    """Measures, shows, writes."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ppo", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, metavar="FILE", help="file of results; the figure goes beside it")
    parser.add_argument("--env", default="panda4dof", choices=mimic.environments(), metavar="NAME")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), metavar="CASE", help="; ".join(CASES))
    parser.add_argument("--num-envs", type=int, metavar="N", help="arms at once; the preset's")
    parser.add_argument("--batch-size", type=int, metavar="N", help="unrolls in a minibatch; the preset's")
    parser.add_argument("--batches", type=int, metavar="N", help="between two looks at the clock")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()
    config = PPOConfig(num_envs=options.num_envs, batch_size=options.batch_size)
    config = config.resolve(jax.default_backend(), jax.device_count())
    batches = options.batches or (10 if jax.default_backend() == "gpu" else 1)
    rows = run(options.env, config, options.only, batches)
    Console().print(table(rows))
    if options.out:
        write_results(
            options.out, "ppo", options.commit, settings=settings(config), layers=config.hidden_layers, rows=rows
        )
        draw(rows, options.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
