"""Damaged and hostile inputs: rejected in one line or accepted; no traceback, wait, crash, or other numbers.

    python -m benchmarks.fuzz [--kind models runs] [--count N] [--out FILE]

Case n of a kind changes one file of a valid example, in the same way each time; `--only` repeats some cases and prints
their messages. A case has 60 s and 2 GB in a process of its own. The exit code is 1 if one of them did harm.
"""

import collections
import contextlib
import functools
import io
import math
import multiprocessing
import os
import pickle
import re
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.random import Generator

import mimic
from benchmarks.common.parser import make_parser
from benchmarks.common.record import print_table, write_results
from mimic.arms.model_files import read_model
from mimic.base.config import flatten, to_dict
from mimic.commands import cli
from mimic.commands.collect.finished_runs import find_runs
from mimic.motions.demonstrations import load_demonstrations
from mimic.motions.formats.lerobot_reading import read_lerobot
from mimic.motions.formats.rosbag2 import read_rosbag2
from mimic.motions.importing import import_demonstrations
from mimic.motions.mocap.reading import read_motion
from mimic.runs.checkpoints import load_training
from mimic.trainers.run_config import load_config, new_run_dir
from tests.helpers import episodes, valid_files
from tests.helpers.valid_files import ARM, PARAMS

TIME_LIMIT, MEMORY_LIMIT = 60, 2 * 2**30  # s, bytes
REJECTED, ACCEPTED = "rejected_in_one_line", "accepted"
OTHER_NUMBERS, REVEALED = "accepted_with_other_numbers", "read_a_secret"
TRACEBACK, HANG, CRASH, MEMORY = "traceback", "hang", "crash", "above_2_gb"
GOOD, BAD = (REJECTED, ACCEPTED), (OTHER_NUMBERS, REVEALED, TRACEBACK, HANG, CRASH, MEMORY)
COLUMNS = " ".join(("kind inputs", *GOOD, *BAD, "slowest_s"))
SECRET_NAME, SECRET = "SECRET_TOKEN", "fuzz-5e1f-secret"  # a variable's value, and a body in a file outside
Row = dict[str, Any]

# --- how a user's command reads a file ---


def read_motions(folder: Path, changed: Path) -> Any:
    if changed.parts[0] == "lerobot":
        return read_lerobot(folder / "lerobot", episodes.EXPERT)
    if changed.parts[0] == "bags":
        return read_rosbag2(folder / "bags", episodes.EXPERT)
    if changed.stem == "imported":
        return vars(import_demonstrations(changed, ARM)[0])
    return vars(load_demonstrations(changed))


def read_models(folder: Path, changed: Path) -> Any:
    outside = f'<mujoco><worldbody><body name="{SECRET}"><geom size="1"/></body></worldbody></mujoco>'
    (folder / "outside.xml").write_text(outside)
    file = changed if changed.suffix == ".urdf" else folder / "arm" / "arm.xml"
    mimic.load_mjcf(file)
    return read_model(file).names


def read_runs(folder: Path, changed: Path) -> Any:
    find_runs(folder)
    config = load_config(folder / "run")
    with contextlib.redirect_stderr(io.StringIO()) as error:
        checkpoint = load_training(folder / "run", PARAMS)
    if error.getvalue():  # a damaged checkpoint is named and the one before it loaded
        raise ValueError(error.getvalue().strip())
    return vars(config) if "checkpoints" not in changed.parts else checkpoint._asdict()


def read_command_lines(folder: Path, changed: Path) -> Any:
    """Runs a command up to its checked config.

    Raises:
      ValueError: the line that it is rejected with.
      RuntimeError: any other end.
    """
    command, configs = changed.name.partition("_")[0], []
    arguments = changed.read_bytes().decode(errors="replace").split("\n") if changed.is_file() else []

    def prepare(config: Any) -> cli.Work:
        configs.append(config)
        if command == "train":
            new_run_dir(config)
            config.resolve("cpu", 1)
        return lambda: 0

    code: Any = 0
    out, error, line = io.StringIO(), io.StringIO(), [f"mimic.{command}", *arguments]
    with mock.patch("sys.argv", line), contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            cli.run(prepare, command)
        except SystemExit as stop:
            code = stop.code or 0
    numbers = [x for config in configs for x in flatten(to_dict(config)).values() if isinstance(x, float)]
    if not all(map(math.isfinite, numbers)):
        raise RuntimeError(f"a number that is not finite in {configs}")
    is_line = error.getvalue().startswith("error: ") and error.getvalue().count("\n") == 1
    if code == cli.BAD_INPUT and is_line:
        raise ValueError(error.getvalue().strip())
    if code == 0 or (code == 1 and "sweep:" in out.getvalue()):  # the runs of a sweep fail one by one
        return out.getvalue(), list(map(str, configs))
    raise RuntimeError(f"{arguments}: exit code {code}: {error.getvalue()}")


KINDS: dict[str, tuple[Callable[[Path], None], Callable[[Path, Path], Any]]] = {  # write a valid example; read it
    "motions": (valid_files.write_motions, read_motions),
    "models": (valid_files.write_models, read_models),
    "captures": (valid_files.write_captures, lambda folder, changed: vars(read_motion(changed))),
    "runs": (valid_files.write_runs, read_runs),
    "command_lines": (valid_files.write_command_lines, read_command_lines),
}

# --- changes of a file ---

_WORDS = """../outside.xml ..&#47;outside.xml /etc/hosts /proc/self/environ /dev/zero ../../.. . ${oc.env:SECRET_TOKEN}
\\${oc.env:SECRET_TOKEN} ${seed} ${..} ${${seed}} ${run_dir} nan .inf -1e30 1e400 -1 0 1e-320 2147483648 1e9 [1e30]
0x10 1,2 null {} [] [[1]] '' " ' \0 \u00e9 \u202e &a *a --- ~env <!-- --> <![CDATA[ !!python/object:os.system --bogus
= MOTION } true @ env={} \ud800 -m --cfg --help"""
_TEXTS = """<include file='../outside.xml'/>
<INCLUDE file='../outside.xml' />
<!DOCTYPE m [<!ENTITY e 'e'>]>
<replicate count='1000000'>
<size nkey='2000000000' memory='100T'/>
&a [*a]
"""
_LONG = ("[" * 3000, "<a>" * 3000, "9" * 400, "a\nb", "\u2028")
ODD = [text.encode(errors="surrogatepass") for text in (*_WORDS.split(), *_TEXTS.splitlines(), *_LONG)]


def changes(data: bytes, rng: Generator) -> dict[str, Callable[[], bytes]]:
    """Functions that change the content of a file, by what they do."""
    start, end = sorted(int(place) for place in rng.integers(len(data) + 1, size=2))
    end = min(end, start + int(rng.integers(1, 400)))
    words = [match.span() for match in re.finditer(rb"[\w.+/${}-]+", data)] or [(0, 0)]
    first, last = words[int(rng.integers(len(words)))]
    odd, lines = ODD[int(rng.integers(len(ODD)))], data.split(b"\n")
    line, flip = lines[int(rng.integers(len(lines)))], 1 << int(rng.integers(8))
    return {
        "odd word": lambda: data[:first] + odd + data[last:],
        "odd text inserted": lambda: data[:start] + odd + data[start:],
        "odd text repeated": lambda: data[:start] + odd * 300 + data[start:],
        "flipped bit": lambda: data[:start] + bytes(b ^ flip for b in data[start : start + 1]) + data[start + 1 :],
        "truncated": lambda: data[:start],
        "part deleted": lambda: data[:start] + data[end:],
        "part doubled": lambda: data[:end] + data[start:],
        "line doubled": lambda: data[:start] + b"\n" + line + b"\n" + data[start:],
        "random bytes": lambda: rng.bytes(start),
        "UTF-16": lambda: data.decode("latin-1").encode("utf-16"),
        "repeated": lambda: (data or b"x") * (1 + 2**20 // (len(data) + 1)),
    }  # fmt: skip


SPECIAL: dict[str, Callable[[Path], None]] = {
    "deleted": lambda path: None,
    "pipe": os.mkfifo,
    "folder": os.mkdir,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "dangling link": lambda path: path.symlink_to("missing"),
}


@functools.cache
def example(kind: str) -> dict[Path, bytes]:
    """The files of a valid example."""
    with tempfile.TemporaryDirectory() as folder:
        KINDS[kind][0](Path(folder))
        files = sorted(path for path in Path(folder).rglob("*") if path.is_file())
        return {path.relative_to(folder): path.read_bytes() for path in files}


def write_case(kind: str, number: int) -> tuple[str, Path]:
    """Writes the changed example of a case into this folder; returns the name of the case and the changed file."""
    rng = np.random.default_rng([2027, zlib.crc32(kind.encode()), number])
    files = example(kind)
    changed = list(files)[int(rng.integers(len(files)))]
    edits = changes(files[changed], rng)
    names = [*edits, *SPECIAL]
    name = names[number % len(names)]
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if path == changed and name in SPECIAL:
            SPECIAL[name](path)
        else:
            path.write_bytes(edits[name]() if path == changed else content)
    return f"{name} in {changed}", changed


# --- running cases ---


def run_case(kind: str, number: int) -> Row:
    """The outcome of a case, in this process."""
    began, value, message = time.perf_counter(), None, ""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # of NumPy: lines that a user would see
        name, changed = write_case(kind, number)
        try:
            value = KINDS[kind][1](Path(), changed)
            # Checksums protect these: what is accepted has the numbers of the example.
            is_exact = changed.suffix == ".npz" or "checkpoints" in changed.parts
            is_same = not is_exact or pickle.dumps(value) == _value_of_example(kind, changed)
            outcome = ACCEPTED if is_same else OTHER_NUMBERS
        except ValueError as error:
            message = str(error)
            outcome = REJECTED if message and message.splitlines() == [message] else TRACEBACK
        except Exception:  # whatever it is, a user would see a traceback
            outcome, message = TRACEBACK, traceback.format_exc()
    outcome = REVEALED if SECRET in message or SECRET in str(value) else outcome
    seconds = round(time.perf_counter() - began, 2)
    return {"number": number, "case": name, "outcome": outcome, "message": message[-2000:], "s": seconds}


@functools.cache
def _value_of_example(kind: str, changed: Path) -> bytes:
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        KINDS[kind][0](Path())
        return pickle.dumps(KINDS[kind][1](Path(), changed))


def run_limited_case(kind: str, number: int) -> Row:
    """The outcome of a case, which ends this process after the time limit."""
    os.environ[SECRET_NAME] = SECRET
    example(kind)
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak of this process' memory
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(TIME_LIMIT)
    row = run_case(kind, number)
    signal.alarm(0)
    peak = re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())
    return row | ({"outcome": MEMORY} if peak and int(peak[1]) * 1024 > MEMORY_LIMIT else {})


def run_cases(kind: str, numbers: Sequence[int], processes: int) -> list[Row]:
    """Runs some cases, in processes that are replaced where one hangs or crashes."""
    with ThreadPoolExecutor(processes) as threads:
        parts = threads.map(lambda start: _in_process(kind, numbers[start::processes]), range(processes))
        return sorted((row for part in parts for row in part), key=lambda row: row["number"])


def _in_process(kind: str, numbers: Sequence[int]) -> list[Row]:
    rows, pool = [], None
    for number in numbers:
        pool = pool or ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
        began = time.perf_counter()
        try:
            rows.append(pool.submit(run_limited_case, kind, number).result())
        except BrokenProcessPool:
            seconds, pool = time.perf_counter() - began, None
            outcome = HANG if seconds >= TIME_LIMIT else CRASH
            rows.append({"number": number, "case": "", "outcome": outcome, "message": "", "s": round(seconds, 2)})
    if pool is not None:
        pool.shutdown()
    return rows


def main() -> None:
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    parser = make_parser("fuzz", __doc__, kind=tuple(KINDS), count=600, processes=os.cpu_count() or 1, only=[0])
    parser.set_defaults(only=None)
    options = parser.parse_args()
    rows, bad = [], []
    for kind in options.kind:
        cases = run_cases(kind, options.only or range(options.count), options.processes)
        counts = collections.Counter(case["outcome"] for case in cases)
        slowest = max(case["s"] for case in cases)
        rows.append({"kind": kind, "inputs": len(cases), **{o: counts[o] for o in (*GOOD, *BAD)}, "slowest_s": slowest})
        bad += [{"kind": kind, **case} for case in cases if case["outcome"] in BAD or options.only]
        write_results(options, count=options.count, kinds=rows, bad=bad)
    print_table(rows, COLUMNS)
    for case in bad:
        print("{kind} {number} ({case}): {outcome} in {s} s: {message}".format_map(case))
    if any(case["outcome"] in BAD for case in bad):
        sys.exit("error: some inputs were not answered as they should")


if __name__ == "__main__":
    main()
