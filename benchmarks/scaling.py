"""PPO on several GPUs of one host: environment steps per second with learning, and quality of the policy.

    python -m benchmarks.scaling --out FILE [--devices 1 2 4 8] [--processes one each] [--env panda4dof] [--seeds 0 1]

Each device has as many arms, samples and steps as a run on one device has (weak scaling). A run is one process with all
devices, or one process per device. The speed is the median between two evaluations.
"""

import argparse
import itertools
import os
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax

from benchmarks.common.parser import make_parser
from benchmarks.common.processes import read_metrics, train
from benchmarks.common.record import Row, print_table, write_results
from benchmarks.common.timing import summary_of_rates
from mimic.trainers.presets import PPO_PRESETS

PROCESSES = ("one", "each")  # for all devices, or for each
STEPS = 30_000_000  # of one device
_EVALUATIONS = 8
_PREALLOCATE = "XLA_PYTHON_CLIENT_PREALLOCATE"
COLUMNS = "devices processes steps_per_s:,.0f efficiency:.1% gap:.2% gap_deviation:.2% seeds"


def environment(devices: int) -> dict[str, str]:
    """Environment variables of a run: the GPUs that are visible to it."""
    inherited = {key: value for key, value in os.environ.items() if key != _PREALLOCATE}
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    names = visible.split(",") if visible else [str(index) for index in range(devices)]
    return {**inherited, "CUDA_VISIBLE_DEVICES": ",".join(names[:devices])}


def measure(devices: int, processes: int, seed: int, common: Sequence[str], of_one: dict[str, int]) -> Row:
    local = ["distributed.coordinator=local", f"distributed.processes={processes}"] if processes > 1 else []
    sizes = [f"trainer.{key}={value * devices}" for key, value in of_one.items()]
    training = [*common, *sizes, f"seed={seed}", *local]
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        result = train(run_dir, training, env=environment(devices))
        rates = [rate for (rate,) in read_metrics(run_dir, "training/sps")][1:]  # the first compiles
    row = {"devices": devices, "processes": processes, "seed": seed, **summary_of_rates(rates)}
    row |= {key: result["report"][key] for key in ("optimality_gap", "env_steps")}
    return row | {key: result[key] for key in ("process_wall_s", "arguments")}


def summary(runs: Sequence[Row]) -> list[Row]:
    """Medians over the seeds; efficiency is the speed of a device relative to that with the fewest, in one process."""
    groups: dict[tuple[int, int], list[Row]] = {}
    for run in runs:
        groups.setdefault((run["devices"], run["processes"]), []).append(run)
    rates = {key: statistics.median(run["steps_per_s"] for run in group) for key, group in groups.items()}
    first, rows = min(groups), []
    for devices, processes in sorted(groups, key=lambda key: (key[1] > 1, key[0])):
        gaps, rate = [run["optimality_gap"]["train"] for run in groups[devices, processes]], rates[devices, processes]
        row = {"devices": devices, "processes": processes, "steps_per_s": rate}
        row |= {"efficiency": rate / devices / (rates[first] / first[0]), "gap": statistics.fmean(gaps)}
        rows.append(row | {"gap_deviation": statistics.stdev(gaps) if len(gaps) > 1 else 0.0, "seeds": len(gaps)})
    return rows


def run(options: argparse.Namespace) -> Iterator[Row]:
    """Rows of the runs as they end."""
    of_one = {"num_envs": options.num_envs, "batch_size": options.batch_size, "num_timesteps": options.steps}
    common = [f"env={options.env}", f"trainer.evaluations={_EVALUATIONS}", *options.arguments]
    for devices, seed, division in itertools.product(sorted(options.devices), options.seeds, options.processes):
        if devices > 1 or division == options.processes[0]:
            yield measure(devices, devices if division == "each" else 1, seed, common, of_one)


def main() -> None:
    os.environ[_PREALLOCATE] = "false"  # this process only lists the devices; their memory is for the runs
    sizes = {key: PPO_PRESETS["gpu"][key] for key in ("num_envs", "batch_size")}
    lists = {"devices": [1, 2, 4, 8], "processes": PROCESSES, "seeds": [0]}
    parser = make_parser("scaling", __doc__, env="panda4dof", steps=STEPS, **sizes, **lists)
    parser.add_argument("--arguments", nargs="*", default=[], metavar="KEY=VALUE", help="further ones of mimic.train")
    options = parser.parse_args()
    count = jax.device_count() if jax.default_backend() == "gpu" else 0
    if max(options.devices) > count:
        parser.error(f"--devices: this host has {count} GPUs, got {max(options.devices)}")
    runs = []
    for row in run(options):
        runs.append(row)  # a run that fails loses none of those before
        write_results(options, env=options.env, rows=summary(runs), runs=runs)
    print_table(summary(runs), COLUMNS)


if __name__ == "__main__":
    main()
