"""Time and size of checkpoints of PPO, with the whole state of the training and with the parameters alone.

    python -m benchmarks.checkpoints --arms 512 4096 65536 --out FILE

The state is that of `env=panda4dof trainer.preset=gpu` with each number of arms. The last column is the time that it
adds to a checkpoint, as a fraction of a training epoch (19 million steps) at `--steps-per-second`.
"""

import dataclasses
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from mimic.runs.checkpoints import load_checkpoint, load_training, save_checkpoint
from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo import ppo

_REPEATS = 7


def main() -> None:
    parser = make_parser("checkpoints", __doc__, arms=[512, 4096, 65_536], steps_per_second=5e6)
    options = parser.parse_args()
    epoch_s = PPOConfig(preset="gpu").resolve().num_timesteps / 8 / options.steps_per_second
    rows = [measure(arms) for arms in options.arms]
    for row in rows:
        row["of_epoch"] = (row["save_s"] - row["save_params_s"]) / epoch_s
    print_table(rows, "arms size_mb:.1f params_mb:.1f save_s:.3f save_params_s:.3f load_s:.3f of_epoch:.2%")
    write_results(options, results=rows)


def measure(arms: int) -> Row:
    """Median times [s] and sizes [MB] of a checkpoint with a number of arms."""
    state = training_state(arms)
    params = jax.tree.map(np.asarray, state.params)
    leaves = jax.tree.leaves(state.saved)
    with tempfile.TemporaryDirectory() as folder:
        run_dir, template = Path(folder), params
        row: Row = {"arms": arms}
        for name, content in {"_params": (params,), "": (params, leaves)}.items():
            row[f"save{name}_s"] = _median(lambda content=content: save_checkpoint(run_dir, 0, *content), run_dir)
            files = (run_dir / "checkpoints" / f"{0:012d}").rglob("*")
            row["size_mb" if not name else "params_mb"] = sum(f.stat().st_size for f in files if f.is_file()) / 1e6
        row["load_params_s"] = _median(lambda: load_checkpoint(run_dir, template))
        row["load_s"] = _median(lambda: load_training(run_dir, template))
    return row


def training_state(arms: int) -> ppo.TrainingState:
    """The state at the start of a training."""
    env = mimic.make("panda4dof", physics="fused", demonstrations={"count": 2, "held_out": 1})
    preset = PPOConfig(preset="gpu").resolve()
    minibatch = max(preset.batch_size, arms // preset.num_minibatches)  # a batch has an unroll of each arm at least
    config = dataclasses.replace(preset, num_envs=arms, batch_size=minibatch)
    return jax.device_get(ppo.compile_training(env, config, 1).start(0))


def _median(action: Callable[[], Any], emptied: Path | None = None) -> float:
    """Median wall time of an action [s], in an emptied folder if there is one."""
    times = []
    for _ in range(_REPEATS):
        if emptied:
            shutil.rmtree(emptied / "checkpoints", ignore_errors=True)
        began = time.perf_counter()
        action()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


if __name__ == "__main__":
    main()
