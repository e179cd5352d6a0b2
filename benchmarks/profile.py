"""Where the time of a training goes on the device, and whether it waits for the host: JAX's profiler over one call.

    python -m benchmarks.profile [--out FILE] [--env panda4dof] [--batches 10]

One call of the training program, which collects so many batches and learns from them, after another that warms up. The
kernels that the device ran are added up by what they are; so are copies between host and device, of which there should
be none but what starts the call. Kernels run side by side, so their times add up to more than the call's. "Busy" is the
share of the call's wall time in which a kernel ran.
"""

import argparse
import re
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import optax
from rich.console import Console
from rich.table import Table

import mimic
from benchmarks.record import write_results
from mimic.trainers.config import PPOSettings
from mimic.trainers.ppo import training
from mimic.trainers.ppo.programs import compile_training

# What a kernel is, by its name; the first that fits.
KINDS = (
    ("copy, host to device", r"memcpy.?h2d|memcpyhtod"),
    ("copy, device to host", r"memcpy.?d2h|memcpydtoh"),
    ("copy on the device", r"memcpy|memset"),
    ("matrix products", r"gemm|cublas|cutlass|nvjet|xmma|dot"),
    ("physics", r"^kernel$|kernel_call|_kernel\b|pallas"),
    ("sorting", r"sort|cub::"),
    ("random numbers", r"threefry"),
    ("other fusions", r""),
)
_SHOWN = 12  # kernels of the longest time, in the file


class Event(NamedTuple):
    """What a device did: the name of a kernel or copy, when it began, and for how long [ns]."""

    name: str
    start: float
    duration: float


def device_events(folder: Path) -> list[Event]:
    """Kernels and copies of the devices in a folder of JAX's profiler."""
    (file,) = folder.glob("**/*.xplane.pb")
    return [
        Event(event.name, event.start_ns, event.duration_ns)
        for plane in jax.profiler.ProfileData.from_file(str(file)).planes
        if plane.name.startswith("/device:GPU")
        for line in plane.lines
        if line.name.startswith("Stream")
        for event in line.events
    ]


def kind(name: str) -> str:
    """What a kernel is."""
    return next(what for what, pattern in KINDS if re.search(pattern, name, re.IGNORECASE))


def by_name(events: Iterable[Event], naming: Any) -> list[dict[str, Any]]:
    """How often and how long, the longest first."""
    found: dict[str, list[float]] = {}
    for event in events:
        found.setdefault(naming(event.name), []).append(event.duration)
    rows = [{"what": name, "count": len(times), "ms": sum(times) / 1e6} for name, times in found.items()]
    return sorted(rows, key=lambda row: -row["ms"])


def busy(events: Iterable[Event]) -> float:
    """Seconds in which at least one of the events was under way."""
    total, end = 0.0, 0.0
    for event in sorted(events, key=lambda event: event.start):
        stop = event.start + event.duration
        total += max(stop - max(event.start, end), 0.0)
        end = max(end, stop)
    return total / 1e9


def profile(name: str, batches: int) -> dict[str, Any]:
    """One call of the training program."""
    env = mimic.make(name, physics="fused")
    config = PPOSettings().resolve(jax.default_backend(), jax.device_count())
    networks = training.make_networks(config, env.observation_size, env.action_size)
    schedule = optax.constant_schedule(config.learning_rate)
    begin, program = compile_training(env, config, networks, batches, schedule, None)
    learning, _ = jax.block_until_ready(program()(begin()(0)))
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            began = time.perf_counter()
            learning, _ = jax.block_until_ready(program()(learning))
            wall = time.perf_counter() - began
        events = device_events(Path(folder))
    return {
        "env": name,
        "batches": batches,
        "env_steps": batches * config.steps_per_batch,
        "wall_s": wall,
        "busy_s": busy(events),
        "kinds": by_name(events, kind),
        "kernels": by_name(events, str)[:_SHOWN],
    }


def main() -> None:
    """Profiles, shows, writes."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.profile", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, metavar="FILE", help="file of results; printed only where none is given")
    parser.add_argument("--env", default="panda4dof", choices=mimic.environments(), metavar="NAME")
    parser.add_argument("--batches", type=int, default=10, metavar="N", help="collected and learnt from in the call")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()
    if jax.default_backend() != "gpu":
        parser.error(f"expected a GPU, whose kernels the profiler tells, got {jax.default_backend()}")
    found = profile(options.env, options.batches)
    table = Table("on the device", "times", "ms", "share of all")
    total = sum(row["ms"] for row in found["kinds"])
    for row in found["kinds"]:
        share = row["ms"] / total
        table.add_row(row["what"], f"{row['count']:,}", f"{row['ms']:.2f}", f"{share:.1%}")
    Console().print(table)
    share = found["busy_s"] / found["wall_s"]
    Console().print(f"{found['env_steps']:,} environment steps in {found['wall_s']:.3f} s; busy {share:.1%}")
    if options.out:
        write_results(options.out, "profile", options.commit, **found)


if __name__ == "__main__":
    main()
