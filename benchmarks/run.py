"""Runs benchmarks, and says what of the targets is reached.

    python -m benchmarks.run [all|NAME ...] --out DIR

Each benchmark is a process of its own and writes DIR/NAME_DEVICE.json. The table is made of all files that are in DIR;
without a name it is all that is made.
"""

import argparse
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
from rich.console import Console

from benchmarks import targets

# What each is run with besides, on any device and on a GPU. Poses on a GPU: as many as keep it busy.
BENCHMARKS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "startup": ((), ()),
    "kernel": ((), ()),
    "rollout": ((), ()),
    "physics": ((), ()),
    "bound": ((), ()),
    "pose": ((), ("--batch", "200000", "--poses", "10000")),
    "pose_mapper": ((), ()),
    "training": ((), ()),
    "ppo": ((), ()),
    "scaling": ((), ()),
    "dynamic_imitation": ((), ()),
}


def device_name(kind: str) -> str:
    """Of a device, as a part of a file's name: "h200" of "NVIDIA H200"."""
    return re.sub(r"[^a-z0-9]+", "-", kind.lower().removeprefix("nvidia ")).strip("-")


def command(name: str, out: Path, backend: str, devices: int, commit: str | None) -> list[str]:
    """What runs a benchmark into a file."""
    always, on_gpu = BENCHMARKS[name]
    more = [*always, *(on_gpu if backend == "gpu" else ())]
    if name == "scaling":
        more += ["--devices", *(str(count) for count in (1, 2, 4, 8) if count <= devices)]
    if name == "dynamic_imitation":  # what is there is not done again
        more += ["--runs", str(out.with_suffix("") / "runs")]
    if commit:
        more += ["--commit", commit]
    return [sys.executable, "-m", f"benchmarks.{name}", "--out", str(out), *more]


def run(names: Sequence[str], folder: Path, commit: str | None, console: Console) -> list[str]:
    """Runs benchmarks one after the other; the names of those that failed."""
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # this process only looks at the devices
    backend, devices, device = jax.default_backend(), jax.device_count(), device_name(jax.devices()[0].device_kind)
    del os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"]
    failed = []
    for name in names:
        out = folder / f"{name}_{device}.json"
        console.rule(f"{name}: {out}")
        if subprocess.run(command(name, out, backend, devices, commit), check=False).returncode:
            failed.append(name)
    return failed


def main() -> None:
    """Runs what is named, and shows the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(("all", *BENCHMARKS)))
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the files of results")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()
    if unknown := [name for name in options.names if name not in ("all", *BENCHMARKS)]:
        parser.error(f"unknown benchmark {unknown[0]!r}; valid are all, {', '.join(BENCHMARKS)}")
    options.out.mkdir(parents=True, exist_ok=True)
    console = Console(width=None if sys.stdout.isatty() else 120)
    names = list(BENCHMARKS) if "all" in options.names else list(dict.fromkeys(options.names))
    failed = run(names, options.out, options.commit, console) if names else []
    console.print(targets.table(targets.read_folder(options.out)))
    if failed:
        sys.exit(f"error: failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
