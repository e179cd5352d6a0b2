"""Many runs as processes of their own, several at once: what is done already is not done again."""

import dataclasses
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from mimic.runs.checkpoints import checkpoint_steps
from mimic.runs.files import REPORT


@dataclasses.dataclass(frozen=True)
class Task:
    """A training run, or an evaluation of one.

    Attributes:
      folder: of its results; it is done once the report is there.
      arguments: of `python -m mimic.train`, or of `python -m mimic.evaluate`.
      of: folder of the run that is evaluated; None for a training run.
    """

    folder: Path
    arguments: tuple[str, ...]
    of: Path | None = None

    @property
    def done(self) -> bool:
        return (self.folder / REPORT).is_file()

    def command(self) -> list[str]:
        """What does it, or goes on where it was interrupted."""
        python = [sys.executable, "-m"]
        if self.of is not None:
            shutil.rmtree(self.folder, ignore_errors=True)  # what an interruption left
            return [*python, "mimic.evaluate", f"run={self.of}", f"out={self.folder}", *self.arguments]
        if checkpoint_steps(self.folder):
            return [*python, "mimic.train", f"resume={self.folder}"]
        shutil.rmtree(self.folder, ignore_errors=True)
        return [*python, "mimic.train", f"run_dir={self.folder}", *self.arguments]


def run_tasks(tasks: Sequence[Task], *, jobs: int, devices: int) -> list[Task]:
    """Runs what is not done, `jobs` at once for each device; those that failed.

    A failed task is named with the end of its log, and the others go on. An evaluation waits for its run.

    Args:
      tasks: runs before their evaluations.
      jobs: processes on a device.
      devices: GPUs to spread them over; 0 is the CPU.
    """
    waiting = [task for task in tasks if not task.done]
    running: dict[Task, tuple[subprocess.Popen[bytes], int]] = {}
    failed: list[Task] = []
    columns = TextColumn("[bold]runs"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[now]}")
    with Progress(*columns, TimeElapsedColumn(), disable=not sys.stdout.isatty()) as bar:
        shown = bar.add_task("runs", total=len(tasks), completed=len(tasks) - len(waiting), now="")
        try:
            while waiting or running:
                ready = [task for task in waiting if task.of is None or (task.of / REPORT).is_file()]
                for task in sorted(ready, key=lambda task: task.of is None):  # evaluations first: they are short
                    if len(running) < jobs * max(devices, 1):
                        waiting.remove(task)
                        used = [device for _, device in running.values()]
                        device = min(range(max(devices, 1)), key=used.count)
                        running[task] = _start(task, device if devices else None), device
                for task, (process, _) in list(running.items()):
                    if process.poll() is not None:
                        del running[task]
                        bar.advance(shown)
                        if not task.done:
                            failed.append(task)
                            print(f"failed: {task.folder}: {_log(task).read_text()[-800:]}", flush=True)
                orphans = {task for task in waiting if task.of in {one.folder for one in failed}}
                failed += orphans
                waiting = [task for task in waiting if task not in orphans]
                bar.update(shown, now=", ".join(task.folder.name for task in running))
                time.sleep(0.2)
        finally:  # an interruption reaches the processes too; each writes a checkpoint and ends
            for process, _ in running.values():
                process.terminate()
            for process, _ in running.values():
                process.wait()
    return failed


def _start(task: Task, device: int | None) -> "subprocess.Popen[bytes]":
    environment = dict(os.environ, XLA_PYTHON_CLIENT_PREALLOCATE="false")  # several share a card
    if device is not None:
        environment["CUDA_VISIBLE_DEVICES"] = str(device)
    task.folder.parent.mkdir(parents=True, exist_ok=True)
    with _log(task).open("wb") as log:
        return subprocess.Popen(task.command(), stdout=log, stderr=subprocess.STDOUT, env=environment)


def _log(task: Task) -> Path:
    return task.folder.with_name(task.folder.name + ".log")
