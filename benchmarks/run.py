"""Runs benchmarks and compares their results with the targets.

    python -m benchmarks.run [all|NAME ...] --out DIR

Each benchmark writes DIR/NAME_DEVICE.json. The table of targets is of all files in DIR, also without a name.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import jax

from benchmarks.common import targets
from benchmarks.common.parser import make_parser
from benchmarks.common.record import print_table

BENCHMARKS = (
    "startup", "kernel", "rollout", "physics", "bound", "pose", "pose_mapper", "training", "ppo", "scaling",
    "dynamic_imitation",
)  # fmt: skip


def device_name(kind: str) -> str:
    """A device as part of a file name: "h200" for "NVIDIA H200"."""
    return re.sub(r"[^a-z0-9]+", "-", kind.lower().removeprefix("nvidia ")).strip("-")


def command(name: str, out: Path, backend: str, devices: int, commit: str | None) -> list[str]:
    options = {
        "scaling": ["--devices", *(str(count) for count in (1, 2, 4, 8) if count <= devices)],
        "dynamic_imitation": ["--runs", str(out.with_suffix("") / "runs")],  # what it contains is not repeated
        "pose": ["--batch", "200000", "--poses", "10000"] if backend == "gpu" else [],  # enough to keep a GPU busy
    }
    commit_option = ["--commit", commit] if commit else []
    return [sys.executable, "-m", f"benchmarks.{name}", "--out", str(out), *options.get(name, []), *commit_option]


def main() -> None:
    parser = make_parser("run", __doc__, out="DIR")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(("all", *BENCHMARKS)))
    options = parser.parse_args()
    if unknown := [name for name in options.names if name not in ("all", *BENCHMARKS)]:
        parser.error(f"unknown benchmark {unknown[0]!r}; valid are all, {', '.join(BENCHMARKS)}")
    options.out.mkdir(parents=True, exist_ok=True)
    environment = dict(os.environ)
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # this process only lists the devices
    backend, devices, device = jax.default_backend(), jax.device_count(), device_name(jax.devices()[0].device_kind)
    failed = []
    for name in BENCHMARKS if "all" in options.names else dict.fromkeys(options.names):
        out = options.out / f"{name}_{device}.json"
        print(f"--- {name}: {out}", flush=True)
        arguments = command(name, out, backend, devices, options.commit)
        if subprocess.run(arguments, env=environment, check=False).returncode:
            failed.append(name)
    print_table(targets.table(targets.read_folder(options.out)), "quantity on measured:,.4g target met from")
    if failed:
        sys.exit(f"error: failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
