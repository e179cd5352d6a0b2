"""PPO on several GPUs of one host: environment steps per second with learning, and how good the policy gets.

    python -m benchmarks.scaling --out FILE [--devices 1 2 4 8] [--processes one each] [--env panda4dof] [--seeds 0 1]

Weak scaling gives each device as many arms, minibatches as large and as many steps as one device has; strong scaling
spreads what one device has. A run is one process that sees so many devices, or a process for each of them; without
GPUs, of devices that XLA makes of the processor, which shows that it runs and not how fast. The speed is that of the
training between two evaluations, the median of all but the first, which compiles; efficiency is the speed of a device,
relative to that with the fewest. Strong scaling changes nothing but the random numbers: the gaps must agree within the
noise of the seeds.
"""

import argparse
import csv
import itertools
import os
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import track  # noqa: E402
from rich.table import Table  # noqa: E402

from benchmarks.record import train, write_results  # noqa: E402
from mimic.runs.files import METRICS  # noqa: E402
from mimic.trainers.config import PRESETS  # noqa: E402

KINDS = ("weak", "strong")
PROCESSES = ("one", "each")  # for all devices, or for each
STEPS = {"gpu": 30_000_000, "cpu": 200_000}  # of one device
_EVALUATIONS = 8
_PREALLOCATE = "XLA_PYTHON_CLIENT_PREALLOCATE"


def arguments(kind: str, devices: int, of_one: dict[str, int]) -> list[str]:
    """Of `python -m mimic.train`, for so many devices.

    Args:
      kind: "weak" or "strong".
      devices: to train on.
      of_one: num_envs, batch_size and num_timesteps of one device.
    """
    factor = devices if kind == "weak" else 1
    return [f"trainer.{key}={factor * value}" for key, value in of_one.items()]


def environment(devices: int, processes: int, backend: str) -> dict[str, str]:
    """Of a run that sees so many devices, or so many in all its processes where XLA makes them of the processor."""
    inherited = {key: value for key, value in os.environ.items() if key != _PREALLOCATE}
    if backend == "gpu":
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
        names = visible.split(",") if visible else [str(index) for index in range(devices)]
        return {**inherited, "CUDA_VISIBLE_DEVICES": ",".join(names[:devices])}
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices // processes}"
    return {**inherited, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags.strip()}


def speed(metrics: Path) -> dict[str, float]:
    """Median and spread (quartiles) of the training's steps per second, without the stretch that compiled."""
    with metrics.open(newline="") as file:
        rates = [float(row["training/sps"]) for row in csv.DictReader(file)][1:]
    low, median, high = np.quantile(rates, [0.25, 0.5, 0.75])
    return {"steps_per_s": float(median), "spread": round(float(high - low) / float(median), 4)}


def measure(
    kind: str, devices: int, processes: int, seed: int, common: Sequence[str], of_one: dict[str, int]
) -> dict[str, Any]:
    """One run."""
    given = [*common, *arguments(kind, devices, of_one), f"seed={seed}"]
    backend = jax.default_backend()
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        here = ["distributed.coordinator=local", f"distributed.processes={processes}"] if processes > 1 else []
        result = train(run_dir, [*given, *here], environment=environment(devices, processes, backend))
        rates = speed(run_dir / METRICS)
    report = result["report"]
    return {
        "scaling": kind,
        "devices": devices,
        "processes": processes,
        "seed": seed,
        **rates,
        "optimality_gap": report["optimality_gap"],
        "env_steps": report["env_steps"],
        "process_wall_s": result["process_wall_s"],
        "arguments": result["arguments"],
    }


def summary(results: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each kind, number of devices and of processes: medians over the seeds, efficiency, the gaps' spread.

    Efficiency is relative to the fewest devices, in as few processes.
    """
    keys = sorted({(row["scaling"], row["processes"], row["devices"]) for row in results}, key=_order)
    groups = {key: [r for r in results if (r["scaling"], r["processes"], r["devices"]) == key] for key in keys}
    rates = {key: statistics.median(row["steps_per_s"] for row in rows) for key, rows in groups.items()}
    rows = []
    for (kind, processes, devices), found in groups.items():
        first = min((key for key in keys if key[0] == kind), key=lambda key: (key[2], key[1]))
        gaps = [row["optimality_gap"]["train"] for row in found]
        rate = rates[kind, processes, devices]
        rows.append(
            {
                "scaling": kind,
                "devices": devices,
                "processes": processes,
                "steps_per_s": rate,
                "efficiency": rate / devices / (rates[first] / first[2]),
                "gap": statistics.fmean(gaps),
                "gap_deviation": statistics.stdev(gaps) if len(gaps) > 1 else 0.0,
                "seeds": len(gaps),
            }
        )
    return rows


def _order(key: tuple[str, int, int]) -> tuple[int, bool, int]:
    kind, processes, devices = key
    return KINDS.index(kind), processes > 1, devices


def run(
    kinds: Sequence[str],
    devices: Sequence[int],
    processes: Sequence[str],
    seeds: Sequence[int],
    common: Sequence[str],
    of_one: dict[str, int],
) -> Iterator[dict[str, Any]]:
    """Each run as it ends; on one device it is one of all kinds."""
    jobs = [
        (kind, count, count if how == "each" else 1, seed)
        for count, seed, how, kind in itertools.product(devices, seeds, processes, kinds)
        if count > 1 or (how, kind) == (processes[0], kinds[0])
    ]
    shown = track(jobs, "scaling", console=Console(stderr=True), transient=True)
    for job in shown:
        result = measure(*job, common, of_one)
        yield from ({**result, "scaling": kind} for kind in (kinds if result["devices"] == 1 else [job[0]]))


def table(rows: Sequence[dict[str, Any]]) -> Table:
    """Speed, efficiency and quality."""
    shown = Table("scaling", "devices", "processes", "env steps/s", "efficiency", "gap", "seeds")
    for row in rows:
        gap = f"{row['gap']:.2%} ± {row['gap_deviation']:.2%}"
        counts = str(row["devices"]), str(row["processes"])
        shown.add_row(
            row["scaling"], *counts, f"{row['steps_per_s']:,.0f}", f"{row['efficiency']:.1%}", gap, str(row["seeds"])
        )
    return shown


def draw(rows: Sequence[dict[str, Any]], title: str, out: Path) -> None:
    """Steps per second against the devices, with what would be ideal; and the efficiency."""
    figure, (speeds, shares) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for index, (kind, each) in enumerate(itertools.product(KINDS, (False, True))):
        of_kind = [row for row in rows if row["scaling"] == kind]
        line = [row for row in of_kind if row["devices"] == 1 or (row["processes"] > 1) == each]
        if all(row["devices"] == 1 for row in line):
            continue
        devices = [row["devices"] for row in line]
        label = f"{kind}, {'a process for each' if each else 'one process'}"
        speeds.plot(devices, [row["steps_per_s"] for row in line], "o-", color=f"C{index}", label=label)
        shares.plot(devices, [row["efficiency"] for row in line], "o-", color=f"C{index}", label=label)
        ideal = [row["steps_per_s"] / row["efficiency"] for row in line]
        speeds.plot(devices, ideal, ":", color="grey", label="" if index else "ideal")
    ticks = sorted({row["devices"] for row in rows})
    for axes in (speeds, shares):
        axes.set(xlabel="devices", title=title)
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    speeds.set_ylabel("environment steps/s, with learning")
    shares.set_ylabel("efficiency")
    figure.savefig(out, dpi=150)
    plt.close(figure)


def _options() -> argparse.Namespace:
    backend = "gpu" if jax.default_backend() == "gpu" else "cpu"
    preset = PRESETS[backend]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, metavar="FILE", help="file of results; the figure goes beside it")
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4, 8], metavar="K")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--processes", nargs="+", choices=PROCESSES, default=list(PROCESSES), help="for the devices")
    parser.add_argument("--env", default="panda4dof", metavar="NAME")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N")
    parser.add_argument("--num-envs", type=int, default=preset["num_envs"], metavar="N", help="arms of one device")
    parser.add_argument("--batch-size", type=int, default=preset["batch_size"], metavar="N", help="of one device")
    parser.add_argument(
        "--steps", type=int, default=STEPS[backend], metavar="N", help="environment steps of one device"
    )
    parser.add_argument(
        "--arguments", nargs="*", default=[], metavar="KEY=VALUE", help="more of `python -m mimic.train`"
    )
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()
    if backend == "gpu" and max(options.devices) > jax.device_count():
        parser.error(f"--devices: this host has {jax.device_count()}, got {max(options.devices)}")
    return options


def main() -> None:
    """Measures, shows, writes."""
    os.environ[_PREALLOCATE] = "false"  # this process looks at the devices alone; their memory is the runs'
    options = _options()
    of_one = {"num_envs": options.num_envs, "batch_size": options.batch_size, "num_timesteps": options.steps}
    common = [f"env={options.env}", "env.physics=fused", f"trainer.evaluations={_EVALUATIONS}", *options.arguments]
    results, rows = [], []
    for result in run(options.kinds, sorted(options.devices), options.processes, options.seeds, common, of_one):
        results.append(result)
        rows = summary(results)
        if options.out:  # a run that fails loses none of those before it
            write_results(options.out, "scaling", options.commit, env=options.env, rows=rows, runs=results)
    Console().print(table(rows))
    if options.out:
        draw(rows, options.env, options.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
