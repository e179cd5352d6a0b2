"""PPO on several GPUs of one host: environment steps per second with learning, and quality of the policy.

    python -m benchmarks.scaling --out FILE [--devices 1 2 4 8] [--processes one each] [--env panda4dof] [--seeds 0 1]

Weak scaling gives each device as many arms, samples of a minibatch and steps as one device alone has; strong scaling
distributes those of one device. A run is one process that sees all devices, or a process for each; without GPUs, of
devices that XLA makes of the CPU, which shows that it runs and not how fast. The speed is that of training between two
evaluations, the median of all but the first, which compiles; efficiency is the speed of a device relative to that with
the fewest devices. Strong scaling changes the random numbers alone: its gaps must agree within the noise of the seeds.
"""

import itertools
import os
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import track

from benchmarks.common.parser import BenchmarkParser
from benchmarks.common.processes import read_metrics, train
from benchmarks.common.record import Results, Row, print_table
from benchmarks.figures.canvas import plt, save
from mimic.trainers.config import PRESETS

KINDS = ("weak", "strong")
PROCESSES = ("one", "each")  # for all devices, or for each
STEPS = {"gpu": 30_000_000, "cpu": 200_000}  # of one device
_EVALUATIONS = 8
_PREALLOCATE = "XLA_PYTHON_CLIENT_PREALLOCATE"
COLUMNS = {
    **{name: f"{{{name}}}" for name in ("scaling", "devices", "processes")},
    "env steps/s": "{steps_per_s:,.0f}",
    "efficiency": "{efficiency:.1%}",
    "gap": "{gap:.2%} ± {gap_deviation:.2%}",
    "seeds": "{seeds}",
}


def arguments(kind: str, devices: int, of_one: dict[str, int]) -> list[str]:
    """Arguments of `python -m mimic.train` for a number of devices.

    Args:
      kind: "weak" or "strong".
      devices: to train on.
      of_one: num_envs, batch_size and num_timesteps of one device.
    """
    factor = devices if kind == "weak" else 1
    return [f"trainer.{key}={factor * value}" for key, value in of_one.items()]


def environment(devices: int, processes: int, backend: str) -> dict[str, str]:
    """Variables of a run that sees so many GPUs, or whose processes together have so many devices made of the CPU."""
    inherited = {key: value for key, value in os.environ.items() if key != _PREALLOCATE}
    if backend == "gpu":
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
        names = visible.split(",") if visible else [str(index) for index in range(devices)]
        return {**inherited, "CUDA_VISIBLE_DEVICES": ",".join(names[:devices])}
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices // processes}"
    return {**inherited, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags.strip()}


def speed(run_dir: Path) -> dict[str, float]:
    """Median and spread (quartiles) of the training's steps per second, without the first, which compiles."""
    rates = [rate for (rate,) in read_metrics(run_dir, "training/sps")][1:]
    low, median, high = (float(x) for x in np.quantile(rates, [0.25, 0.5, 0.75]))
    return {"steps_per_s": median, "spread": round((high - low) / median, 4)}


def measure(
    kind: str, devices: int, processes: int, seed: int, common: Sequence[str], of_one: dict[str, int]
) -> Row:
    """One run."""
    local = ["distributed.coordinator=local", f"distributed.processes={processes}"] if processes > 1 else []
    variables = environment(devices, processes, jax.default_backend())
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        training = [*common, *arguments(kind, devices, of_one), f"seed={seed}", *local]
        result = train(run_dir, training, environment=variables)
        rates = speed(run_dir)
    return {
        "scaling": kind,
        "devices": devices,
        "processes": processes,
        "seed": seed,
        **rates,
        **{key: result["report"][key] for key in ("optimality_gap", "env_steps")},
        **{key: result[key] for key in ("process_wall_s", "arguments")},
    }


def summary(runs: Sequence[Row]) -> list[Row]:
    """A row for each kind and number of processes and devices: medians over the seeds, efficiency, spread of the gaps.

    Efficiency is relative to the fewest devices, in as few processes.
    """
    groups: dict[tuple[str, int, int], list[Row]] = {}
    for run in runs:
        groups.setdefault((run["scaling"], run["processes"], run["devices"]), []).append(run)
    rates = {key: statistics.median(run["steps_per_s"] for run in group) for key, group in groups.items()}
    rows = []
    for key in sorted(groups, key=lambda key: (KINDS.index(key[0]), key[1] > 1, key[2])):
        kind, processes, devices = key
        first = min((other for other in groups if other[0] == kind), key=lambda key: (key[2], key[1]))
        gaps = [run["optimality_gap"]["train"] for run in groups[key]]
        rows.append(
            {
                "scaling": kind,
                "devices": devices,
                "processes": processes,
                "steps_per_s": rates[key],
                "efficiency": rates[key] / devices / (rates[first] / first[2]),
                "gap": statistics.fmean(gaps),
                "gap_deviation": statistics.stdev(gaps) if len(gaps) > 1 else 0.0,
                "seeds": len(gaps),
            }
        )
    return rows


def run(
    kinds: Sequence[str],
    devices: Sequence[int],
    processes: Sequence[str],
    seeds: Sequence[int],
    common: Sequence[str],
    of_one: dict[str, int],
) -> Iterator[Row]:
    """Each run as it ends; a run on one device counts for all kinds."""
    jobs = [
        (kind, count, count if division == "each" else 1, seed)
        for count, seed, division, kind in itertools.product(devices, seeds, processes, kinds)
        if count > 1 or (division, kind) == (processes[0], kinds[0])
    ]
    for job in track(jobs, "scaling", console=Console(stderr=True), transient=True):
        result = measure(*job, common, of_one)
        yield from ({**result, "scaling": kind} for kind in (kinds if result["devices"] == 1 else [job[0]]))


def draw(rows: Sequence[Row], title: str, out: Path) -> None:
    """Steps per second against the number of devices, with the ideal; and the efficiency."""
    figure, (speeds, efficiencies) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for index, (kind, each) in enumerate(itertools.product(KINDS, (False, True))):
        line = [r for r in rows if r["scaling"] == kind and (r["devices"] == 1 or (r["processes"] > 1) == each)]
        if all(row["devices"] == 1 for row in line):
            continue
        devices, rates, fractions = ([r[key] for r in line] for key in ("devices", "steps_per_s", "efficiency"))
        style: dict[str, Any] = {"color": f"C{index}", "marker": "o"}
        speeds.plot(devices, rates, **style, label=f"{kind}, {'a process for each' if each else 'one process'}")
        efficiencies.plot(devices, fractions, **style)
        speeds.plot(devices, np.divide(rates, fractions), ":", color="grey", label="" if index else "ideal")
    ticks = sorted({row["devices"] for row in rows})
    for axes, label in ((speeds, "environment steps/s, with learning"), (efficiencies, "efficiency")):
        axes.set(xlabel="devices", ylabel=label, title=title)
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    speeds.legend(fontsize="small")
    save(figure, out)


def main() -> None:
    os.environ[_PREALLOCATE] = "false"  # this process only lists the devices; their memory is for the runs
    backend = "gpu" if jax.default_backend() == "gpu" else "cpu"
    parser = BenchmarkParser("scaling", __doc__)
    parser.add_numbers("--devices", [1, 2, 4, 8], "numbers of devices")
    parser.add_names("--kinds", KINDS)
    parser.add_names("--processes", PROCESSES)
    parser.add_argument("--env", default="panda4dof", metavar="NAME")
    parser.add_numbers("--seeds", [0], "of the runs")
    of_one = {**{key: PRESETS[backend][key] for key in ("num_envs", "batch_size")}, "steps": STEPS[backend]}
    for key, value in of_one.items():
        flag = f"--{key.replace('_', '-')}"
        parser.add_argument(flag, type=int, default=value, metavar="N", help="of one device")
    parser.add_argument("--arguments", nargs="*", default=[], metavar="KEY=VALUE", help="further ones of mimic.train")
    options = parser.parse_args()
    if backend == "gpu" and max(options.devices) > jax.device_count():
        parser.error(f"--devices: this host has {jax.device_count()}, got {max(options.devices)}")
    of_one = {"num_envs": options.num_envs, "batch_size": options.batch_size, "num_timesteps": options.steps}
    common = [f"env={options.env}", "env.physics=fused", f"trainer.evaluations={_EVALUATIONS}", *options.arguments]
    results, runs = Results("scaling", options), []
    for row in run(options.kinds, sorted(options.devices), options.processes, options.seeds, common, of_one):
        runs.append(row)
        results.write(env=options.env, rows=summary(runs), runs=runs)  # a run that fails loses none of those before
    print_table(summary(runs), COLUMNS)
    if results.figure:
        draw(summary(runs), options.env, results.figure)


if __name__ == "__main__":
    main()
