"""Memory, open files and disk of a running process, sampled over time."""

import contextlib
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.common.record import Row
from benchmarks.common.trend import trend

_PAGE = os.sysconf("SC_PAGE_SIZE")
_MIB = 2**20
_HOUR = 3600.0


def sample(pid: int, folder: Path | None = None) -> Row:
    """Resident memory [MiB], open file handles and threads of a process; size [MiB] and number of files of a folder."""
    process = Path(f"/proc/{pid}")
    row = {
        "memory_mib": int((process / "statm").read_text().split()[1]) * _PAGE / _MIB,
        "handles": len(os.listdir(process / "fd")),
        "threads": len(os.listdir(process / "task")),
    }
    if folder is not None:
        sizes = list(_sizes(folder))
        row |= {"disk_mib": sum(sizes) / _MIB, "files": len(sizes)}
    return row


def _sizes(folder: Path) -> Iterator[int]:
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):  # removed since it was listed
            if path.is_file():
                yield path.stat().st_size


def sample_process(process: "subprocess.Popen[str]", seconds: float, every: float, folder: Path) -> list[Row]:
    """Samples a process for a time [s], or until it ends; each row has its time since the start [s]."""
    began, rows = time.monotonic(), []
    while (elapsed := time.monotonic() - began) < seconds and process.poll() is None:
        with contextlib.suppress(OSError):  # the process has just ended
            rows.append({"time_s": round(elapsed, 2), **sample(process.pid, folder)})
        time.sleep(every)
    return rows


def trends(rows: list[Row], names: list[str]) -> list[Row]:
    """Start, end and slope per hour of some entries of the samples, with the interval of 95 % confidence."""
    hours = [row["time_s"] / _HOUR for row in rows]
    results = []
    for name in names:
        values = [row[name] for row in rows]
        change = trend(hours, values)
        results.append(
            {
                "what": name, "first": values[0], "last": values[-1], "maximum": max(values),
                "per_hour": change.slope, "low": change.low, "high": change.high, "flat": change.is_flat,
            }
        )  # fmt: skip
    return results
