"""A run of a sweep as a command of its own, which launchers start on the run's machine.

Processes share no state of Hydra or JAX, and the failure of one run does not end another.
"""

import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from mimic.base.files import read_text
from mimic.base.overrides import setting
from mimic.runs.signals import NOTED, STOPPED_BY_SIGNAL
from mimic.runs.sweeps.sweeper import FAILED, Outcome

_POLL_S = 0.2
_FORWARDED = tuple(number for number in NOTED if number.name in ("SIGTERM", "SIGHUP"))


@dataclasses.dataclass
class RunCommand:
    """A run as a command with a log file; it is called on the run's machine.

    Attributes:
      module: Python module that the command runs.
      arguments: arguments of the command.
      folder: working directory of the command.
      log: file that its output is appended to, relative to `folder`.
      run_dir: run directory, relative to `folder`. Default "": unknown.
      environment: environment variables to set; those that are None are removed.
    """

    module: str
    arguments: list[str]
    folder: str
    log: str
    run_dir: str = ""
    environment: dict[str, str | None] = dataclasses.field(default_factory=dict)

    def __call__(self) -> Outcome:
        """Runs the command. Forwards SIGTERM, SIGHUP and Ray's way to cancel, KeyboardInterrupt, as SIGTERM."""
        variables = {**os.environ, **self.environment}
        with (Path(self.folder) / self.log).open("a") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", self.module, *self.arguments],
                cwd=self.folder,
                env={name: value for name, value in variables.items() if value is not None},
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # signals reach it only through this process
            )
        self._process = process
        previous = {number: signal.signal(number, lambda *_: process.terminate()) for number in _FORWARDED}
        try:
            while process.poll() is None:  # not wait(), which `checkpoint` could not interrupt
                time.sleep(_POLL_S)
        except KeyboardInterrupt:
            process.terminate()
        finally:
            if process.returncode is None:
                process.terminate()
                process.wait()
            for number, handler in previous.items():
                signal.signal(number, handler or signal.SIG_DFL)
        return self._outcome(process.wait())

    def checkpoint(self) -> Any:
        """Called by submitit at Slurm's time limit: stops the run and queues it again to be resumed."""
        import submitit

        self._process.terminate()
        with contextlib.suppress(ChildProcessError):  # already ended and reaped
            os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT)
        can_resume = self.run_dir and (Path(self.folder) / self.run_dir / "config.yaml").exists()
        arguments = [setting("resume", self.run_dir)] if can_resume else self.arguments
        return submitit.helpers.DelayedSubmission(dataclasses.replace(self, arguments=arguments))

    def _outcome(self, exit_code: int) -> Outcome:
        if exit_code < 0:
            return Outcome(FAILED, f"killed by {signal.Signals(-exit_code).name}; log: {self.log}")
        if exit_code > STOPPED_BY_SIGNAL:
            name = signal.Signals(exit_code - STOPPED_BY_SIGNAL).name
            return Outcome(
                exit_code, f"stopped by {name}; continue with: python -m {self.module} resume={self.run_dir}"
            )
        if exit_code:
            lines = read_text(Path(self.folder) / self.log, errors="replace").split("\n")
            last = next((line.strip() for line in reversed(lines) if line.strip()), f"exit code {exit_code}")
            return Outcome(exit_code, f"{last.removeprefix('error: ')}; log: {self.log}")
        return Outcome()
