"""Device time of a training by kind of kernel, and copies between host and device, by JAX's profiler.

    python -m benchmarks.profile [--out FILE] [--env panda4dof] [--batches 10]

Profiles one training epoch after another one that compiles. The times of concurrent kernels are added up, so their sum
can exceed the epoch; "busy" is the time in which at least one kernel ran.
"""

import re
import sys
import tempfile
import time
from collections import namedtuple
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo.ppo import compile_training

KINDS = {  # of kernels, by patterns of their names; the first that matches
    "copy, host to device": r"memcpy.?h2d|memcpyhtod",
    "copy, device to host": r"memcpy.?d2h|memcpydtoh",
    "copy on the device": r"memcpy|memset",
    "matrix products": r"gemm|cublas|cutlass|nvjet|xmma|dot",
    "physics": r"^kernel$|kernel_call|_kernel\b|pallas",
    "sorting": r"sort|cub::",
    "random numbers": r"threefry",
    "other fusions": r"",
}
_LONGEST = 12  # kernels that the file lists

Event = namedtuple("Event", "name start duration")  # a kernel or copy on a device; [ns]


def device_events(folder: Path) -> list[Event]:
    """Kernels and copies of the devices, in a folder of JAX's profiler."""
    (file,) = folder.glob("**/*.xplane.pb")
    planes = jax.profiler.ProfileData.from_file(str(file)).planes
    lines = [line for plane in planes if plane.name.startswith("/device:GPU") for line in plane.lines]
    events = [event for line in lines if line.name.startswith("Stream") for event in line.events]
    return [Event(event.name, event.start_ns, event.duration_ns) for event in events]


def kind(name: str) -> str:
    return next(kind for kind, pattern in KINDS.items() if re.search(pattern, name, re.IGNORECASE))


def by_name(events: Iterable[Event], naming: Callable[[str], str]) -> list[Row]:
    """Count and total time of the events of each name, the longest first."""
    rows: dict[str, Row] = {}
    for event in events:
        row = rows.setdefault(naming(event.name), {"what": naming(event.name), "count": 0, "ms": 0.0})
        row |= {"count": row["count"] + 1, "ms": row["ms"] + event.duration / 1e6}
    return sorted(rows.values(), key=lambda row: -row["ms"])


def busy(events: Iterable[Event]) -> float:
    total, end = 0.0, 0.0
    for event in sorted(events, key=lambda event: event.start):
        stop = event.start + event.duration
        total += max(stop - max(event.start, end), 0.0)
        end = max(end, stop)
    return total / 1e9


def profile(name: str, batches: int) -> dict[str, Any]:
    env = mimic.make(name, physics="fused")
    config = PPOConfig().resolve(jax.default_backend(), jax.device_count())
    start, _, epoch = compile_training(env, config, batches)
    state, _ = jax.block_until_ready(epoch()(start(0)))
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            began = time.perf_counter()
            jax.block_until_ready(epoch()(state))
            wall = time.perf_counter() - began
        events = device_events(Path(folder))
    row = {"env": name, "batches": batches, "env_steps": batches * config.steps_per_batch, "wall_s": wall}
    return {**row, "busy_s": busy(events), "kinds": by_name(events, kind), "kernels": by_name(events, str)[:_LONGEST]}


def main() -> None:
    options = make_parser("profile", __doc__, env="panda4dof", batches=10).parse_args()
    if jax.default_backend() != "gpu":
        sys.exit(f"error: expected a GPU, whose kernels the profiler records, got {jax.default_backend()}")
    content = profile(options.env, options.batches)
    print_table(content["kinds"], "what count:, ms:.2f")
    print_table([content], "env_steps:, wall_s:.3f busy_s:.3f")
    write_results(options, **content)


if __name__ == "__main__":
    main()
