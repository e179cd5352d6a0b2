"""Runs that are killed at random moments and resumed, compared with the run that is never interrupted.

    python -m benchmarks.interruptions --kills 200 --out FILE [--trainer pose_mapper] [--seed 0] [ARGUMENT ...]

Trains one run to its end, the reference. Then trains the same run again and again: each process is killed (SIGKILL) at
a random moment between its start and the time that the reference took, and the run is resumed, until it ends. Each run
must end with the reference's parameters to the bit, and with its table of metrics except for times.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from mimic.runs.files import METRICS, REPORT

_SMALL = [
    *("env=planar4dof", "env.demonstrations.count=3", "env.demonstrations.held_out=1"),
    *("trainer.num_timesteps=20000", "trainer.num_envs=32", "trainer.batch_size=32", "trainer.num_minibatches=4"),
    *("trainer.evaluations=8", "trainer.hidden_layers=[16]"),
]
_SMALL_MAPPER = [
    *("env=planar4dof", "trainer=pose_mapper", "trainer.samples=256", "trainer.batch_size=32", "trainer.epochs=16"),
    *("trainer.evaluations=8", "trainer.hidden_layers=[16]", "trainer.validation_poses=64"),
    "trainer.held_out_poses=64",
]
_TIMES = ("wall_time_s", "training/sps", "training/walltime")


def main() -> None:
    parser = make_parser("interruptions", __doc__, kills=20, seed=0, trainer="ppo")
    parser.add_argument("arguments", nargs="*", help="of mimic.train, instead of a run of seconds")
    chosen = parser.parse_args()
    arguments = chosen.arguments or (_SMALL if chosen.trainer == "ppo" else _SMALL_MAPPER)
    with tempfile.TemporaryDirectory() as folder:
        rows = interrupted_runs(Path(folder), arguments, chosen.kills, chosen.seed)
    print_table(rows, "run kills equal where_killed")
    write_results(chosen, results=rows)
    if not all(row["equal"] for row in rows):
        sys.exit("error: a run differs from the reference")


def interrupted_runs(folder: Path, arguments: Sequence[str], kills: int, seed: int) -> list[Row]:
    """Trains the reference, and interrupted runs up to a number of kills; one row for each run.

    Args:
      folder: for the run directories; those of runs that differ from the reference are kept.
      arguments: of `mimic.train`.
      kills: number of processes to kill.
      seed: of the random moments.
    """
    rng = random.Random(seed)
    reference = folder / "reference"
    train = [sys.executable, "-m", "mimic.train"]
    of_process = [argument for argument in arguments if argument.startswith("compilation_cache=")]
    began = time.perf_counter()
    if error := _run([*train, *arguments, f"run_dir={reference}"], None):
        raise RuntimeError(f"the reference failed: {error}")
    duration = time.perf_counter() - began
    rows: list[Row] = []
    while (done := sum(row["kills"] for row in rows)) < kills:
        run_dir, moments, problem = folder / f"interrupted-{len(rows)}", [], ""
        while not (run_dir / REPORT).is_file() and not problem:
            moment = rng.uniform(0, duration) if done + len(moments) < kills else None
            start = f"resume={run_dir}" if (run_dir / "config.yaml").is_file() else f"run_dir={run_dir}"
            problem = _run([*train, *(of_process if start[:6] == "resume" else arguments), start], moment)
            if problem == "killed":
                moments.append(_stage(run_dir))
                problem = ""
        different = problem or differences(reference, run_dir)
        rows.append(
            {"run": len(rows), "kills": len(moments), "equal": not different, "where_killed": dict(Counter(moments))}
        )
        if different:
            print(f"run {rows[-1]['run']}: {different}; kept in {shutil.move(run_dir, tempfile.mkdtemp())}", flush=True)
        else:
            shutil.rmtree(run_dir)
        print(f"run {rows[-1]['run']}: {rows[-1]}", flush=True)
    return rows


def _run(command: Sequence[str], kill_after_s: float | None) -> str:
    """Runs a process, and kills its process group after a time; "" for success, "killed", or its error output."""
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        _, error = process.communicate(timeout=kill_after_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return "killed"
    return "" if process.returncode == 0 else f"exit code {process.returncode}: {error[-1000:]}"


def _stage(run_dir: Path) -> str:
    """How far a killed run was."""
    checkpoints = run_dir / "checkpoints"
    names = [path.name for path in checkpoints.iterdir()] if checkpoints.is_dir() else []
    if any(".partial" in name for name in names):
        return "checkpoint"
    if not (run_dir / "config.yaml").is_file():
        return "start"
    return f"after {sum(name.isdigit() for name in names)} checkpoints"


def differences(reference: Path, run_dir: Path) -> str:
    """How the last checkpoint and the metrics of a run differ from the reference's; "" for equal ones."""
    expected, actual = (_content(folder) for folder in (reference, run_dir))
    if expected.keys() != actual.keys():
        return f"checkpoints or arrays: {sorted(expected.keys() ^ actual.keys())[:5]}"
    different = [name for name, value in expected.items() if not np.array_equal(value, actual[name])]
    return f"values of {different[:5]}" if different else ""


def _content(run_dir: Path) -> dict[str, Any]:
    """The training's state at the end, and the metrics except for times."""
    import csv

    last = max(path for path in (run_dir / "checkpoints").iterdir() if path.name.isdigit())
    with np.load(last / "training.npz") as file:
        content: dict[str, Any] = {f"{last.name}/{name}": file[name] for name in file.files}
    with (run_dir / METRICS).open(newline="") as file:
        for row in csv.DictReader(file):
            content |= {f"{row['step']}/{name}": value for name, value in row.items() if name not in _TIMES}
    return content


if __name__ == "__main__":
    main()
