"""Training runs and other commands as processes."""

import csv
import json
import os
import queue
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track

from mimic.runs.files import METRICS, REPORT

_HELD = 3  # successive evaluations


def run_process(command: Sequence[str], **options: Any) -> float:
    """Runs a command to its end and returns its wall time [s]; exits with the end of its error output if it fails."""
    began = time.perf_counter()
    process = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    if process.returncode:
        sys.exit(f"error: {' '.join(command)} ended with {process.returncode}: {process.stderr[-2000:]}")
    return round(time.perf_counter() - began, 1)


def train(
    run_dir: Path,
    arguments: Sequence[str],
    cache: Path | None = None,
    environment: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """One training run in a new folder: its report, and the wall time of the process [s].

    Args:
      run_dir: the new folder.
      arguments: of `python -m mimic.train`.
      cache: compilation cache; none if None.
      environment: variables of the process; those of this one if None.
    """
    command = [sys.executable, "-m", "mimic.train", *arguments, f"run_dir={run_dir}"]
    wall = run_process([*command, f"compilation_cache={cache or ''}"], env=environment)
    report = json.loads((run_dir / REPORT).read_text())
    report = {key: value for key, value in report.items() if key not in ("hardware", "versions")}
    return {"arguments": list(arguments), "process_wall_s": wall, "report": report}


def read_metrics(run_dir: Path, *columns: str) -> list[tuple[float, ...]]:
    """Columns of a run's metrics, one row for each evaluation."""
    with (run_dir / METRICS).open(newline="") as file:
        return [tuple(float(row[column]) for column in columns) for row in csv.DictReader(file)]


def time_to_goal(run_dir: Path, quality: str, goal: float) -> float | None:
    """Time since the start of the process [s] of the first of three successive evaluations at or below a goal.

    Of all that remain, if the training ends before; None if there are none such.
    """
    rows = read_metrics(run_dir, f"quality/{quality}", "wall_time_s")
    times = (wall for i, (_, wall) in enumerate(rows) if all(value <= goal for value, _ in rows[i : i + _HELD]))
    return next(times, None)


def run_parallel(commands: Mapping[Path, Sequence[str]], *, jobs: int, devices: int) -> list[Path]:
    """Runs commands in parallel; the logs of those that failed, whose last lines are printed.

    Ctrl-C reaches the commands that run, and the others are not started.

    Args:
      commands: by their log files.
      jobs: processes on each device.
      devices: number of GPUs; 0 for the CPU.
    """
    slots: queue.Queue[int] = queue.Queue()
    for slot in range(jobs * max(devices, 1)):
        slots.put(slot % max(devices, 1))

    def run(log: Path) -> bool:
        device = slots.get()
        variables = dict(os.environ, XLA_PYTHON_CLIENT_PREALLOCATE="false")  # several share a GPU
        if devices:
            variables["CUDA_VISIBLE_DEVICES"] = str(device)
        with log.open("wb") as file:
            code = subprocess.run(commands[log], stdout=file, stderr=file, env=variables, check=False).returncode
        slots.put(device)
        return code == 0

    failed = []
    pool = ThreadPoolExecutor(slots.qsize())
    try:
        logs = {pool.submit(run, log): log for log in commands}
        for ended in track(as_completed(logs), "processes", len(logs), console=Console(stderr=True)):
            if not ended.result():
                failed.append(logs[ended])
                print(f"failed: {logs[ended].stem}: {logs[ended].read_text(errors='replace')[-800:]}", flush=True)
    finally:
        pool.shutdown(cancel_futures=True)
    return failed
