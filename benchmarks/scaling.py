"""PPO on several GPUs of one host: environment steps per second with learning, and how good the policy gets.

    python -m benchmarks.scaling --out FILE [--devices 1 2 4 8] [--env panda4dof] [--seeds 0 1]

Weak scaling gives each device as many arms, minibatches as large and as many steps as one device has; strong scaling
spreads what one device has. Each run is a process of its own that sees so many devices; without GPUs, so many that XLA
makes of the processor, which shows that it runs and not how fast. The speed is that of the training between two
evaluations, the median of all but the first, which compiles; efficiency is the speed of a device, relative to that with
the fewest. Strong scaling changes nothing but the random numbers: the gaps must agree within the noise of the seeds.
"""

import argparse
import csv
import os
import statistics
import tempfile
from collections.abc import Sequence
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
from mimic.trainers import runs  # noqa: E402
from mimic.trainers.config import PRESETS  # noqa: E402

KINDS = ("weak", "strong")
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


def environment(devices: int, backend: str) -> dict[str, str]:
    """Of a process that sees so many devices."""
    inherited = {key: value for key, value in os.environ.items() if key != _PREALLOCATE}
    if backend == "gpu":
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
        names = visible.split(",") if visible else [str(index) for index in range(devices)]
        return {**inherited, "CUDA_VISIBLE_DEVICES": ",".join(names[:devices])}
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    return {**inherited, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags.strip()}


def speed(metrics: Path) -> dict[str, float]:
    """Median and spread (quartiles) of the training's steps per second, without the stretch that compiled."""
    with metrics.open(newline="") as file:
        rates = [float(row["training/sps"]) for row in csv.DictReader(file)][1:]
    low, median, high = np.quantile(rates, [0.25, 0.5, 0.75])
    return {"steps_per_s": float(median), "spread": round(float(high - low) / float(median), 4)}


def measure(kind: str, devices: int, seed: int, common: Sequence[str], of_one: dict[str, int]) -> dict[str, Any]:
    """One run."""
    given = [*common, *arguments(kind, devices, of_one), f"seed={seed}"]
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        result = train(run_dir, given, environment=environment(devices, jax.default_backend()))
        rates = speed(run_dir / runs.METRICS)
    report = result["report"]
    return {
        "scaling": kind,
        "devices": devices,
        "seed": seed,
        **rates,
        "optimality_gap": report["optimality_gap"],
        "env_steps": report["env_steps"],
        "process_wall_s": result["process_wall_s"],
        "arguments": result["arguments"],
    }


def summary(results: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each kind and number of devices: medians over the seeds, efficiency, and the gaps' spread."""
    rows = []
    for kind in KINDS:
        of_kind = [row for row in results if row["scaling"] == kind]
        rates = {
            devices: statistics.median(row["steps_per_s"] for row in of_kind if row["devices"] == devices)
            for devices in sorted({row["devices"] for row in of_kind})
        }
        for devices, rate in rates.items():
            fewest = min(rates)
            gaps = [row["optimality_gap"]["train"] for row in of_kind if row["devices"] == devices]
            rows.append(
                {
                    "scaling": kind,
                    "devices": devices,
                    "steps_per_s": rate,
                    "efficiency": rate / devices / (rates[fewest] / fewest),
                    "gap": statistics.fmean(gaps),
                    "gap_deviation": statistics.stdev(gaps) if len(gaps) > 1 else 0.0,
                    "seeds": len(gaps),
                }
            )
    return rows


def run(
    kinds: Sequence[str], devices: Sequence[int], seeds: Sequence[int], common: Sequence[str], of_one: dict[str, int]
) -> list[dict[str, Any]]:
    """All runs; on one device both kinds are the same one."""
    results: list[dict[str, Any]] = []
    jobs = [(count, seed, kind) for count in devices for seed in seeds for kind in kinds]
    for count, seed, kind in track(jobs, "scaling", console=Console(stderr=True), transient=True):
        if count == 1 and results and (results[-1]["devices"], results[-1]["seed"]) == (count, seed):
            results.append({**results[-1], "scaling": kind})
        else:
            results.append(measure(kind, count, seed, common, of_one))
    return results


def table(rows: Sequence[dict[str, Any]]) -> Table:
    """Speed, efficiency and quality."""
    shown = Table("scaling", "devices", "env steps/s", "efficiency", "gap", "seeds")
    for row in rows:
        gap = f"{row['gap']:.2%} ± {row['gap_deviation']:.2%}"
        speed, efficiency = f"{row['steps_per_s']:,.0f}", f"{row['efficiency']:.1%}"
        shown.add_row(row["scaling"], str(row["devices"]), speed, efficiency, gap, str(row["seeds"]))
    return shown


def draw(rows: Sequence[dict[str, Any]], title: str, out: Path) -> None:
    """Steps per second against the devices, with what would be ideal; and the efficiency."""
    figure, (speeds, shares) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for index, kind in enumerate(KINDS):
        of_kind = [row for row in rows if row["scaling"] == kind]
        if not of_kind:
            continue
        devices, rates = [row["devices"] for row in of_kind], [row["steps_per_s"] for row in of_kind]
        ideal = [rates[0] * count / devices[0] for count in devices]
        speeds.loglog(devices, rates, "o-", color=f"C{index}", label=kind)
        speeds.loglog(devices, ideal, ":", color=f"C{index}", label=f"{kind}, ideal")
        shares.semilogx(devices, [row["efficiency"] for row in of_kind], "o-", color=f"C{index}", label=kind)
    ticks = sorted({row["devices"] for row in rows})
    for axes in (speeds, shares):
        axes.set(xlabel="devices", title=title)
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    speeds.set_ylabel("environment steps/s, with learning")
    shares.set_ylabel("efficiency")
    shares.set_ylim(bottom=0)
    figure.savefig(out, dpi=150)
    plt.close(figure)


def _options() -> argparse.Namespace:
    backend = "gpu" if jax.default_backend() == "gpu" else "cpu"
    preset = PRESETS[backend]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, metavar="FILE", help="file of results; the figure goes beside it")
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4, 8], metavar="K")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
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
    results = run(options.kinds, sorted(options.devices), options.seeds, common, of_one)
    rows = summary(results)
    Console().print(table(rows))
    if options.out:
        write_results(options.out, "scaling", options.commit, env=options.env, rows=rows, runs=results)
        draw(rows, options.env, options.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
