"""PPO on several GPUs of one host: environment steps per second with learning, and quality of the policy.

    python -m benchmarks.scaling --out FILE [--devices 1 2 4 8] [--processes one each] [--env panda4dof] [--seeds 0 1]

Weak scaling gives each device as many arms, samples and steps as a run on one device has; strong scaling distributes
that work, so its gaps must agree within noise. A run is one process with all devices, or one process per device.
Without GPUs, XLA divides the CPU into devices. The speed is the median between two evaluations.
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
from benchmarks.figures.canvas import plt, save
from mimic.trainers.presets import PPO_PRESETS

KINDS = ("weak", "strong")
PROCESSES = ("one", "each")  # for all devices, or for each
STEPS = {"gpu": 30_000_000, "cpu": 200_000}  # of one device
_EVALUATIONS = 8
_PREALLOCATE = "XLA_PYTHON_CLIENT_PREALLOCATE"
COLUMNS = "scaling devices processes steps_per_s:,.0f efficiency:.1% gap:.2% gap_deviation:.2% seeds"


def environment(devices: int, processes: int, backend: str) -> dict[str, str]:
    """Environment variables of a run: the GPUs that are visible to it, or the CPU devices of each process."""
    inherited = {key: value for key, value in os.environ.items() if key != _PREALLOCATE}
    if backend == "gpu":
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
        names = visible.split(",") if visible else [str(index) for index in range(devices)]
        return {**inherited, "CUDA_VISIBLE_DEVICES": ",".join(names[:devices])}
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices // processes}"
    return {**inherited, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags.strip()}


def measure(kind: str, devices: int, processes: int, seed: int, common: Sequence[str], of_one: dict[str, int]) -> Row:
    local = ["distributed.coordinator=local", f"distributed.processes={processes}"] if processes > 1 else []
    sizes = [f"trainer.{key}={value * devices if kind == 'weak' else value}" for key, value in of_one.items()]
    training = [*common, *sizes, f"seed={seed}", *local]
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        result = train(run_dir, training, env=environment(devices, processes, jax.default_backend()))
        rates = [rate for (rate,) in read_metrics(run_dir, "training/sps")][1:]  # the first compiles
    row = {"scaling": kind, "devices": devices, "processes": processes, "seed": seed, **summary_of_rates(rates)}
    row |= {key: result["report"][key] for key in ("optimality_gap", "env_steps")}
    return row | {key: result[key] for key in ("process_wall_s", "arguments")}


def summary(runs: Sequence[Row]) -> list[Row]:
    """Medians over the seeds; efficiency is the speed of a device relative to that with the fewest, in one process."""
    groups: dict[tuple[int, int, int], list[Row]] = {}
    for run in runs:
        groups.setdefault((KINDS.index(run["scaling"]), run["processes"], run["devices"]), []).append(run)
    rates = {key: statistics.median(run["steps_per_s"] for run in group) for key, group in groups.items()}
    rows = []
    for key in sorted(groups, key=lambda key: (key[0], key[1] > 1, key[2])):
        kind, processes, devices = key
        first = min((other for other in groups if other[0] == kind), key=lambda other: (other[2], other[1]))
        gaps = [run["optimality_gap"]["train"] for run in groups[key]]
        row = {"scaling": KINDS[kind], "devices": devices, "processes": processes, "steps_per_s": rates[key]}
        row |= {"efficiency": rates[key] / devices / (rates[first] / first[2]), "gap": statistics.fmean(gaps)}
        rows.append(row | {"gap_deviation": statistics.stdev(gaps) if len(gaps) > 1 else 0.0, "seeds": len(gaps)})
    return rows


def run(options: argparse.Namespace) -> Iterator[Row]:
    """Rows of the runs as they end; a run on one device is a row of each kind of scaling."""
    of_one = {"num_envs": options.num_envs, "batch_size": options.batch_size, "num_timesteps": options.steps}
    common = [f"env={options.env}", f"trainer.evaluations={_EVALUATIONS}", *options.arguments]
    cases = itertools.product(sorted(options.devices), options.seeds, options.processes, options.kinds)
    for devices, seed, division, kind in cases:
        if devices > 1 or (division, kind) == (options.processes[0], options.kinds[0]):
            result = measure(kind, devices, devices if division == "each" else 1, seed, common, of_one)
            yield from ({**result, "scaling": counted} for counted in (options.kinds if devices == 1 else [kind]))


def draw(rows: Sequence[Row], title: str, out: Path) -> None:
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for kind, each in itertools.product(KINDS, (False, True)):
        line = [r for r in rows if r["scaling"] == kind and (r["devices"] == 1 or (r["processes"] > 1) == each)]
        label = f"{kind}, {'a process for each' if each else 'one process'}" if len(line) > 1 else None
        for axes, entry in zip(panels, ("steps_per_s", "efficiency"), strict=True):
            axes.plot([row["devices"] for row in line], [row[entry] for row in line], "o-", label=label)
            axes.set(xlabel="devices", ylabel=entry, title=title)
            axes.set_ylim(bottom=0)
    panels[0].legend(fontsize="small")
    save(figure, out)


def main() -> None:
    os.environ[_PREALLOCATE] = "false"  # this process only lists the devices; their memory is for the runs
    backend = "gpu" if jax.default_backend() == "gpu" else "cpu"
    sizes = {"num_envs": PPO_PRESETS[backend]["num_envs"], "batch_size": PPO_PRESETS[backend]["batch_size"]}
    lists = {"devices": [1, 2, 4, 8], "kinds": KINDS, "processes": PROCESSES, "seeds": [0]}
    parser = make_parser("scaling", __doc__, env="panda4dof", steps=STEPS[backend], **sizes, **lists)
    parser.add_argument("--arguments", nargs="*", default=[], metavar="KEY=VALUE", help="further ones of mimic.train")
    options = parser.parse_args()
    if backend == "gpu" and max(options.devices) > jax.device_count():
        parser.error(f"--devices: this host has {jax.device_count()}, got {max(options.devices)}")
    runs = []
    for row in run(options):
        runs.append(row)  # a run that fails loses none of those before
        write_results(options, env=options.env, rows=summary(runs), runs=runs)
    print_table(summary(runs), COLUMNS)
    if options.out:
        draw(summary(runs), options.env, options.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
