"""How long a newcomer waits, on a fresh clone: `python -m benchmarks.newcomer [--out FILE] [--default] [--note TEXT]`.

Install, first trained policy, first video, first own arm, in the words of the README. Nothing is compiled before: the
home folder is a new one, and pip downloads what it installs. Needs git, make and a package index.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.record import commit_id, write_results

REPOSITORY = Path(__file__).resolve().parent.parent
PYTHON = ".venv/bin/python"


@dataclasses.dataclass(frozen=True)
class Stage:
    """Something that a newcomer does, in the clone.

    Attributes:
      name: what it brings.
      command: what is typed.
      report: of a training run that it leaves, relative to the clone.
    """

    name: str
    command: tuple[str, ...]
    report: str = ""


INSTALL = Stage("install", ("make", "install"))
DEFAULT = Stage("first policy, by default", ("make", "train", "ARGS=env.physics=fused run_dir=default"), "default")
STAGES = (
    INSTALL,
    Stage(
        "first policy, short",
        ("make", "train", "ARGS=env=planar4dof env.physics=fused trainer.num_timesteps=500000 run_dir=short"),
        "short",
    ),
    Stage("first video", (PYTHON, "-m", "mimic.render", "run=short")),
    Stage("first own arm", (PYTHON, "examples/07_own_arm.py", "own_arm"), "own_arm/run"),
)


def run_stage(stage: Stage, clone: Path, home: Path) -> dict[str, Any]:
    """Its wall time [s], the load of the machine when it began, and the gaps that were reached."""
    # pip's settings may be in the real home.
    own = {"PIP_NO_CACHE_DIR": "1"} if stage is INSTALL else {"HOME": str(home)}
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")} | own
    load, began = os.getloadavg()[0], time.perf_counter()
    # Not every python3 is new enough; this one is.
    command = [*stage.command, f"PYTHON={sys.executable}"] if stage.command[0] == "make" else stage.command
    finished = subprocess.run(command, cwd=clone, env=environment, capture_output=True, text=True, check=False)
    wall = time.perf_counter() - began
    if finished.returncode:
        sys.exit(f"error: {' '.join(stage.command)} ended with {finished.returncode}: {finished.stderr[-2000:]}")
    result: dict[str, Any] = {"stage": stage.name, "command": " ".join(stage.command), "wall_s": round(wall, 1)}
    if stage.report:
        report = json.loads((clone / stage.report / "report.json").read_text())
        result |= {"env_steps": report["env_steps"], "optimality_gap": report["optimality_gap"]}
    return {**result, "load_at_start": round(load, 1)}


def table(results: list[dict[str, Any]]) -> Table:
    """A row for each stage; wall times in seconds."""
    shown = Table("stage", "seconds", "gap, held out", "load at start")
    for result in results:
        gap = result.get("optimality_gap")
        shown.add_row(
            result["stage"],
            f"{result['wall_s']:.0f}",
            f"{gap['held_out']:.1%}" if gap else "-",
            f"{result['load_at_start']:.1f}",
        )
    return shown


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.newcomer", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, metavar="FILE", help="file of results; printed only where none is given")
    parser.add_argument("--default", action="store_true", help="`make train` as it is too: three minutes on two cores")
    parser.add_argument("--note", default="", metavar="TEXT", help="kept with the results")
    return parser.parse_args()


def main() -> None:
    """Walks the path, and writes the file after each stage."""
    options = _arguments()
    results: list[dict[str, Any]] = []
    stages = (*STAGES, DEFAULT) if options.default else STAGES
    with tempfile.TemporaryDirectory() as folder:
        clone, home = Path(folder) / "mimic", Path(folder) / "home"
        home.mkdir()
        subprocess.run(["git", "clone", "--quiet", str(REPOSITORY), str(clone)], check=True)
        for stage in stages:
            results.append(run_stage(stage, clone, home))
            if options.out:
                write_results(options.out, "newcomer", commit_id(), note=options.note, stages=results)
    Console().print(table(results))


if __name__ == "__main__":
    main()
