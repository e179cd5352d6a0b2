"""Runs cases one by one, in processes that are replaced when one hangs or crashes."""

import collections
import contextlib
import multiprocessing
import shutil
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from benchmarks.fuzzing import ACCEPTED, OTHER_NUMBERS, Case, make_case

TIME_LIMIT = 20.0  # s
MEMORY_LIMIT = 2 * 2**30  # bytes
REJECTED, TRACEBACK, HANG, CRASH, MEMORY = "rejected_in_one_line", "traceback", "hang", "crash", "above_2_gb"
OUTCOMES = (REJECTED, ACCEPTED, OTHER_NUMBERS, TRACEBACK, HANG, CRASH, MEMORY)
GOOD = (REJECTED, ACCEPTED)
Row = dict[str, Any]


def run_case(case: Case, folder: Path) -> tuple[str, str]:
    """The outcome of a case in an empty folder, and its message."""
    case.write(folder)
    try:
        with contextlib.chdir(folder):
            return case.read(folder), ""
    except ValueError as error:
        message = str(error)
        is_line = bool(message) and message.splitlines() == [message]
        return (REJECTED if is_line else TRACEBACK), message
    except Exception:  # whatever it is, a user would see a traceback
        return TRACEBACK, traceback.format_exc()


def run_here(kind: str, numbers: Sequence[int]) -> list[Row]:
    """Runs cases in this process, without limits."""
    make = make_case(kind)
    rows = []
    for number in numbers:
        with tempfile.TemporaryDirectory() as folder:
            case, began = make(number), time.perf_counter()
            outcome, message = run_case(case, Path(folder))
            seconds = time.perf_counter() - began
            rows.append({"number": number, "case": case.name, "outcome": outcome, "message": message, "s": seconds})
    return rows


def run_cases(kind: str, count: int, processes: int) -> list[Row]:
    """Runs the first cases of a kind in some processes, each case with limits on time and memory."""
    parts = [range(start, count, processes) for start in range(processes)]
    with ThreadPoolExecutor(processes) as pool:
        rows = [row for part in pool.map(lambda numbers: list(_in_process(kind, numbers)), parts) for row in part]
    return sorted(rows, key=lambda row: row["number"])


def summary(kind: str, rows: Sequence[Row]) -> Row:
    """Counts of the outcomes of a kind, overall and by case, and all bad ones."""
    by_case: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    for row in rows:
        by_case[row["case"]][row["outcome"]] += 1
    counts = collections.Counter(row["outcome"] for row in rows)
    return {
        "kind": kind,
        "inputs": len(rows),
        **{outcome: counts[outcome] for outcome in OUTCOMES},
        "slowest_s": round(max((row["s"] for row in rows), default=0.0), 2),
        "largest_mb": round(max((row.get("mb", 0) for row in rows), default=0.0)),
        "by_case": {name: dict(by_case[name]) for name in sorted(by_case)},
        "bad": [row for row in rows if row["outcome"] not in GOOD],
    }


def _in_process(kind: str, numbers: Sequence[int]) -> Iterator[Row]:
    context = multiprocessing.get_context("spawn")
    worker: tuple[Any, Connection] | None = None
    for number in numbers:
        if worker is None:
            connection, other = context.Pipe()
            process = context.Process(target=_serve, args=(kind, other), daemon=True)
            process.start()
            other.close()
            worker = process, connection
            connection.recv()  # it has imported what it needs
        process, connection = worker
        with tempfile.TemporaryDirectory() as folder:
            connection.send((number, folder))
            row = _reply(connection, number)
            if row["outcome"] in (HANG, CRASH):
                process.kill()
                process.join()
                worker = None
                shutil.rmtree(folder, ignore_errors=True)
                Path(folder).mkdir(exist_ok=True)
        yield row
    if worker is not None:
        worker[1].send(None)
        worker[0].join()


def _reply(connection: Connection, number: int) -> Row:
    row: Row = {"number": number, "case": make_name(connection)}
    try:
        if connection.poll(TIME_LIMIT):
            return row | connection.recv()
        return row | {"outcome": HANG, "message": "", "s": TIME_LIMIT}
    except (EOFError, ConnectionError):
        return row | {"outcome": CRASH, "message": "", "s": 0.0}


def make_name(connection: Connection) -> str:
    """The name of the case, which a process sends before it reads the input."""
    try:
        return connection.recv()
    except (EOFError, ConnectionError):
        return "unknown"


def _serve(kind: str, connection: Connection) -> None:
    """Runs the cases whose numbers come through the connection."""
    make = make_case(kind)
    make(0)
    connection.send("ready")
    while (request := connection.recv()) is not None:
        number, folder = request
        case = make(number)
        connection.send(case.name)
        _forget_peak()
        began = time.perf_counter()
        outcome, message = run_case(case, Path(folder))
        seconds, peak = time.perf_counter() - began, _peak_memory()
        outcome = MEMORY if peak > MEMORY_LIMIT else outcome
        connection.send({"outcome": outcome, "message": message[-2000:], "s": round(seconds, 3), "mb": peak / 1e6})


def _forget_peak() -> None:
    with contextlib.suppress(OSError):  # not on this system
        Path("/proc/self/clear_refs").write_text("5")


def _peak_memory() -> int:
    """The maximum of this process' resident memory [bytes] since `_forget_peak`; 0 where the system does not say."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return 0
