"""A run of a sweep as a command of its own, which is what launchers start wherever the run shall be.

Nothing of Hydra's or JAX's state goes from one process to another, and what ends one run ends no other.
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

from mimic.runs.signals import STOPPED_BY_SIGNAL
from mimic.sweeps.sweeper import FAILED, Outcome, path_override

_LOOK_S = 0.2


@dataclasses.dataclass
class RunCommand:
    """A run as a command; called where the run shall be, with its output in a log file.

    Attributes:
      module: that the command runs.
      arguments: of the command.
      folder: that it starts in.
      log: file that its output is added to, seen from there.
      run_dir: where it writes, likewise; empty where nobody knows.
      environment: variables that it gets; without those that are None.
    """

    module: str
    arguments: list[str]
    folder: str
    log: str
    run_dir: str = ""
    environment: dict[str, str | None] = dataclasses.field(default_factory=dict)

    def __call__(self) -> Outcome:
        """Runs it to its end. SIGTERM is passed on to it; KeyboardInterrupt, Ray's way to cancel, becomes SIGTERM."""
        variables = {**os.environ, **self.environment}
        with (Path(self.folder) / self.log).open("a") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", self.module, *self.arguments],
                cwd=self.folder,
                env={name: value for name, value in variables.items() if value is not None},
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # a signal reaches it through this process alone
            )
        self._process = process
        previous = signal.signal(signal.SIGTERM, lambda *_: process.terminate())
        try:
            while process.poll() is None:  # no wait(), which `checkpoint` could not interrupt
                time.sleep(_LOOK_S)
        except KeyboardInterrupt:
            process.terminate()
        finally:
            if process.returncode is None:
                process.terminate()
                process.wait()
            signal.signal(signal.SIGTERM, previous or signal.SIG_DFL)
        return self._outcome(process.wait())

    def checkpoint(self) -> Any:
        """What submitit asks for when Slurm's time is up: the run stops, and is queued again to go on."""
        import submitit

        self._process.terminate()
        with contextlib.suppress(ChildProcessError):  # ended, and known to have
            os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT)
        begun = self.run_dir and (Path(self.folder) / self.run_dir / "config.yaml").exists()
        arguments = [path_override("resume", self.run_dir)] if begun else self.arguments
        return submitit.helpers.DelayedSubmission(dataclasses.replace(self, arguments=arguments))

    def _outcome(self, exit_code: int) -> Outcome:
        if exit_code < 0:
            return Outcome(FAILED, f"killed by {signal.Signals(-exit_code).name}; log: {self.log}")
        if exit_code > STOPPED_BY_SIGNAL:
            name = signal.Signals(exit_code - STOPPED_BY_SIGNAL).name
            return Outcome(exit_code, f"stopped by {name}; go on with: python -m {self.module} resume={self.run_dir}")
        if exit_code:
            lines = (Path(self.folder) / self.log).read_text(errors="replace").split("\n")
            last = next((line.strip() for line in reversed(lines) if line.strip()), f"exit code {exit_code}")
            return Outcome(exit_code, f"{last.removeprefix('error: ')}; log: {self.log}")
        return Outcome()
