"""Training runs and other commands as processes."""

import csv
import json
import os
import queue
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from mimic.runs.files import METRICS, REPORT

_HELD = 3  # successive evaluations


def run_process(command: Sequence[str], **options: Any) -> float:
    """Runs a command to its end and returns its wall time [s]; exits with the end of its error output if it fails."""
    began = time.perf_counter()
    process = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    if process.returncode:
        sys.exit(f"error: {' '.join(command)} ended with {process.returncode}: {process.stderr[-2000:]}")
    return round(time.perf_counter() - began, 1)


def train(run_dir: Path, arguments: Sequence[str], cache: Path | str = "", **options: Any) -> dict[str, Any]:
    """Report of `python -m mimic.train` in a new folder, and wall time of its process [s]; options of `subprocess`."""
    paths = f"run_dir={run_dir}", f"compilation_cache={cache}"
    wall = run_process([sys.executable, "-m", "mimic.train", *arguments, *paths], **options)
    report = json.loads((run_dir / REPORT).read_text())
    report = {key: value for key, value in report.items() if key not in ("hardware", "versions")}
    return {"arguments": list(arguments), "process_wall_s": wall, "report": report}


def read_metrics(run_dir: Path, *columns: str) -> list[tuple[float, ...]]:
    """Columns of a run's metrics, one row for each evaluation."""
    with (run_dir / METRICS).open(newline="") as file:
        return [tuple(float(row[column]) for column in columns) for row in csv.DictReader(file)]


def time_to_goal(run_dir: Path, quality: str, goal: float) -> float | None:
    """Time since the start of the process [s] of the first of three successive evaluations, or all last, at a goal."""
    rows = read_metrics(run_dir, f"quality/{quality}", "wall_time_s")
    times = (wall for i, (_, wall) in enumerate(rows) if all(value <= goal for value, _ in rows[i : i + _HELD]))
    return next(times, None)


def run_parallel(commands: Mapping[Path, Sequence[str]], jobs: int, devices: int) -> list[Path]:
    """Runs commands by their log files, several per GPU or on the CPU; returns the logs of those that failed."""
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
        end = f" failed: {log.read_text(errors='replace')[-800:]}" if code else ""
        print(f"{log.stem}{end}", flush=True)
        return code == 0

    with ThreadPoolExecutor(slots.qsize()) as pool:  # map cancels what has not started when it is interrupted
        return [log for log, done in zip(commands, pool.map(run, commands), strict=True) if not done]
