"""Environment steps per second with learning: PPO on our environments, on a stock one, and as in the paper.

    python -m benchmarks.ppo --out FILE [--env panda4dof] [--only CASE ...] [--num-envs N]

PPO as `mimic.train` runs it, with the settings of the preset, on the environment with the physics `fused` and `mjx`;
brax's own training loop on the same environment, and on the same task as brax and MuJoCo Playground environments
usually implement it, with `mjx.Data` carried and brax's own wrappers. PPO of stable-baselines3 runs on C MuJoCo on the
CPU, where it is installed, with the same networks, minibatches and passes, and an arm for each core. A training is a
number of epochs; the speed is the median of all but the first, which compiles, with the quartiles as spread.
"""

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import optax
from brax.envs.base import Env
from brax.training.agents.ppo import train as brax_ppo
from brax.training.agents.ppo.networks import make_ppo_networks

import mimic
from benchmarks.common.parser import BenchmarkParser
from benchmarks.common.record import Results, Row, failure, print_table
from benchmarks.peers import stock
from mimic import compat
from mimic.envs.imitation import ImitationEnv
from mimic.envs.wrappers import wrap_for_training
from mimic.trainers.config import PPOConfig, PPOSettings
from mimic.trainers.ppo import training
from mimic.trainers.ppo.programs import make_programs

STABLE_BASELINES = "stable-baselines3, C MuJoCo"
EPOCHS = 6  # the first compiles
SETTINGS = (  # that brax's PPO has under the same names
    "num_envs", "learning_rate", "entropy_cost", "discounting", "unroll_length", "batch_size", "num_minibatches",
    "num_updates_per_batch", "reward_scaling", "clipping_epsilon", "gae_lambda", "max_grad_norm",
)  # fmt: skip
COLUMNS = {
    "env": "{env}",
    "PPO on": "{case}",
    "env steps/s": "{steps_per_s:,.0f}",
    "spread": "{spread:.1%}",
    "compile [s]": "{compile_s:.1f}",
}

Case = Callable[[str, PPOSettings, int], dict[str, float]]  # environment, settings, batches of an epoch -> rates


def rates(steps: int, seconds: Sequence[float]) -> dict[str, float]:
    """Speed of epochs of so many steps: median and spread (quartiles) without the first, and how long that compiled."""
    later = np.asarray(seconds[1:])
    low, median, high = np.quantile(steps / later, [0.25, 0.5, 0.75])
    return {
        "compile_s": round(max(seconds[0] - float(np.median(later)), 0.0), 3),
        "steps_per_s": float(median),
        "spread": round(float((high - low) / median), 4),
    }


def settings(config: PPOSettings) -> dict[str, Any]:
    """The settings of a resolved config that all implementations share."""
    return {name: getattr(config, name) for name in SETTINGS}


def training_epoch(env: ImitationEnv, config: PPOSettings, batches: int) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The compiled functions of `mimic.train` that begin a training, and that train for so many batches."""
    networks = training.make_networks(config, env.observation_size, env.action_size)
    schedule = optax.constant_schedule(config.learning_rate)
    return make_programs(env, config, networks, batches, schedule, None)


def mimic_loop(physics: str) -> Case:
    """PPO as `mimic.train` runs it."""

    def case(name: str, config: PPOSettings, batches: int) -> dict[str, float]:
        env = mimic.make(name, physics=physics)
        times = [time.perf_counter()]
        begin, epoch = training_epoch(env, config, batches)
        state = begin()(0)
        for _ in range(EPOCHS):
            state, metrics = epoch()(state)
            jax.block_until_ready(metrics)
            times.append(time.perf_counter())
        return rates(batches * config.steps_per_batch, np.diff(times).tolist())

    return case


def brax_loop(physics: str, make: Callable[[Any], tuple[Env, Callable[..., Env]]]) -> Case:
    """Brax's own training loop, on an environment and with the wrappers that `make` returns."""

    def case(name: str, config: PPOSettings, batches: int) -> dict[str, float]:
        compat.mend_brax()
        imitation = mimic.make(name, physics=physics)
        env, wrap = make(imitation)
        hidden = tuple(config.hidden_layers or ())
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
            network_factory=functools.partial(
                make_ppo_networks, policy_hidden_layer_sizes=hidden, value_hidden_layer_sizes=hidden
            ),
            **settings(config),
        )
        return rates(batches * config.steps_per_batch, np.diff(times).tolist())

    return case


def stable_baselines(name: str, config: PPOSettings, batches: int) -> dict[str, float]:
    from benchmarks.peers import baselines  # of a package that may not be installed

    del batches  # the CPU is slow
    return rates(*baselines.learn(name, config, 1, EPOCHS))


CASES: dict[str, Case] = {
    "mimic, fused": mimic_loop("fused"),
    "mimic, mjx": mimic_loop("mjx"),
    "brax's loop, fused": brax_loop("fused", lambda env: (env, wrap_for_training)),
    "brax's loop, mjx.Data carried": brax_loop("mjx", lambda env: (stock.StockEnv(env), stock.wrap)),
    STABLE_BASELINES: stable_baselines,
}


def run(name: str, config: PPOSettings, cases: Sequence[str], batches: int) -> list[Row]:
    """A row for each case; a case that fails is a row with the reason."""
    rows = []
    for case in cases:
        row: Row = {"env": name, "case": case}
        began = time.perf_counter()
        try:
            row |= CASES[case](name, config, batches)
        except Exception as error:  # not installed, or out of memory
            row |= failure(error)
        rows.append({**row, "wall_s": round(time.perf_counter() - began, 1)})
    return rows


def main() -> None:
    parser = BenchmarkParser("ppo", __doc__)
    parser.add_argument("--env", default="panda4dof", choices=mimic.environments(), metavar="NAME")
    parser.add_names("--only", CASES)
    parser.add_argument("--num-envs", type=int, metavar="N", help="parallel arms; default: of the preset")
    parser.add_argument("--batch-size", type=int, metavar="N", help="unrolls in a minibatch; default: of the preset")
    parser.add_argument("--batches", type=int, metavar="N", help="batches of an epoch")
    options = parser.parse_args()
    config = PPOConfig(num_envs=options.num_envs, batch_size=options.batch_size)
    config = config.resolve(jax.default_backend(), jax.device_count())
    batches = options.batches or (10 if jax.default_backend() == "gpu" else 1)
    rows = run(options.env, config, options.only, batches)
    print_table(rows, COLUMNS)
    Results("ppo", options).write(settings=settings(config), layers=config.hidden_layers, rows=rows)


if __name__ == "__main__":
    main()
