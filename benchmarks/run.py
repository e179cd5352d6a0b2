"""Runs benchmarks and compares their results with the targets.

    python -m benchmarks.run [all|NAME ...] --out DIR

Each benchmark is a process of its own and writes DIR/NAME_DEVICE.json. The table of targets is of all files in DIR;
without a name it is all that is done.
"""

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import jax

from benchmarks.common import targets
from benchmarks.common.parser import BenchmarkParser
from benchmarks.common.record import print_table

BENCHMARKS = (
    "startup", "kernel", "rollout", "physics", "bound", "pose", "pose_mapper", "training", "ppo", "scaling",
    "dynamic_imitation",
)  # fmt: skip
COLUMNS = {name: f"{{{name}}}" for name in ("quantity", "on", "measured", "target", "met", "from")}


def device_name(kind: str) -> str:
    """A device as part of a file name: "h200" for "NVIDIA H200"."""
    return re.sub(r"[^a-z0-9]+", "-", kind.lower().removeprefix("nvidia ")).strip("-")


def command(name: str, out: Path, backend: str, devices: int, commit: str | None) -> list[str]:
    """The command that runs a benchmark."""
    options = {
        "scaling": ["--devices", *(str(count) for count in (1, 2, 4, 8) if count <= devices)],
        "dynamic_imitation": ["--runs", str(out.with_suffix("") / "runs")],  # what it contains is not repeated
        "pose": ["--batch", "200000", "--poses", "10000"] if backend == "gpu" else [],  # enough to keep a GPU busy
    }
    commit_option = ["--commit", commit] if commit else []
    return [sys.executable, "-m", f"benchmarks.{name}", "--out", str(out), *options.get(name, []), *commit_option]


def run(names: Sequence[str], folder: Path, commit: str | None) -> list[str]:
    """Runs benchmarks one after the other and returns those that failed."""
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # this process only lists the devices
    backend, devices, device = jax.default_backend(), jax.device_count(), device_name(jax.devices()[0].device_kind)
    del os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"]
    failed = []
    for name in names:
        out = folder / f"{name}_{device}.json"
        print(f"--- {name}: {out}", flush=True)
        if subprocess.run(command(name, out, backend, devices, commit), check=False).returncode:
            failed.append(name)
    return failed


def main() -> None:
    parser = BenchmarkParser("run", __doc__, out="DIR")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(("all", *BENCHMARKS)))
    options = parser.parse_args()
    if unknown := [name for name in options.names if name not in ("all", *BENCHMARKS)]:
        parser.error(f"unknown benchmark {unknown[0]!r}; valid are all, {', '.join(BENCHMARKS)}")
    options.out.mkdir(parents=True, exist_ok=True)
    names = BENCHMARKS if "all" in options.names else tuple(dict.fromkeys(options.names))
    failed = run(names, options.out, options.commit) if names else []
    print_table(targets.table(targets.read_folder(options.out)), COLUMNS)
    if failed:
        sys.exit(f"error: failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
