"""Waiting times on a fresh clone: `python -m benchmarks.newcomer [--out FILE] [--default] [--note TEXT]`.

Install, first trained policy, first video and first own arm, as in the README, in a new home folder without a
compilation cache; pip downloads what it installs. Needs git, make and a package index.
"""

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from benchmarks.common.parser import make_parser
from benchmarks.common.processes import run_process
from benchmarks.common.record import Row, collect
from mimic.runs.files import REPORT

REPOSITORY = Path(__file__).resolve().parent.parent
SHORT = "ARGS=env=planar4dof trainer.num_timesteps=500000 run_dir=short"
OWN_VARIABLES = "PYTHONPATH", "VIRTUAL_ENV", "XLA_FLAGS"  # mimic sets the last for this process's version of JAX
COLUMNS = "stage wall_s:.0f cpu_s:.0f load_at_start:.1f optimality_gap[held_out]:.1%"


class Stage(NamedTuple):
    """A command of a newcomer, in the clone; `run_dir` is that of the training in it."""

    name: str
    command: tuple[str, ...]
    run_dir: str = ""


INSTALL = Stage("install", ("make", "install"))
DEFAULT = Stage("first policy, by default", ("make", "train", "ARGS=run_dir=default"), "default")
STAGES = (
    INSTALL,
    Stage("first policy, short", ("make", "train", SHORT), "short"),
    Stage("first video", (".venv/bin/python", "-m", "mimic.render", "run=short")),
    Stage("first own arm", (".venv/bin/python", "examples/07_own_arm.py", "own_arm"), "own_arm/run"),
)


def run_stage(stage: Stage, folder: Path, home: Path) -> Row:
    """Wall and CPU time of a stage in a folder [s], load of the machine at its start, and the gaps of its training."""
    # pip's settings may be in the real home.
    changes = {"PIP_NO_CACHE_DIR": "1"} if stage.name == INSTALL.name else {"HOME": str(home)}
    variables = {key: value for key, value in os.environ.items() if key not in OWN_VARIABLES} | changes
    load = round(os.getloadavg()[0], 1)
    # A python3 on the path may be too old.
    command = [*stage.command, f"PYTHON={sys.executable}"] if stage.command[0] == "make" else stage.command
    row: Row = {"stage": stage.name, "command": " ".join(stage.command), "load_at_start": load}
    cpu_before = _cpu_time()
    row["wall_s"] = run_process(command, cwd=folder, env=variables)
    row["cpu_s"] = round(_cpu_time() - cpu_before, 1)
    if stage.run_dir:
        report = json.loads((folder / stage.run_dir / REPORT).read_text())
        row |= {key: report[key] for key in ("env_steps", "optimality_gap")}
    return row


def _cpu_time() -> float:
    """Of all ended processes that this one started [s]: unlike wall time, it hardly depends on what else runs."""
    times = os.times()
    return times.children_user + times.children_system


def main() -> None:
    options = make_parser("newcomer", __doc__, default=False, note="").parse_args()
    with tempfile.TemporaryDirectory() as folder:
        clone, home = Path(folder) / "mimic", Path(folder) / "home"
        home.mkdir()
        run_process(["git", "clone", "--quiet", str(REPOSITORY), str(clone)])
        stages = (*STAGES, DEFAULT) if options.default else STAGES
        rows = (run_stage(stage, clone, home) for stage in stages)
        collect(options, rows, "stages", COLUMNS, note=options.note)


if __name__ == "__main__":
    main()
