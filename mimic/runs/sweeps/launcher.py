"""Base of our launchers: each run of a sweep is started as a command and awaited."""

import importlib
import sys
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import HydraException
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from mimic.base.distribution import install_command
from mimic.runs.signals import Signals, exit_hook, noted_signals
from mimic.runs.sweeps.run_command import RunCommand
from mimic.runs.sweeps.sweeper import FAILED, LOGS, Outcome, path_of

LOCAL = "basic"  # Hydra's own launcher: one run after the other, in the process of the sweep
_POLL_S = 0.2


class CommandLauncher(Launcher):
    """A launcher whose runs are commands, of which at most `max_parallel` run in parallel."""

    choice: str  # hydra/launcher=choice
    extra: str
    package: str
    max_parallel: int | None = None  # maximum number of runs in parallel; None: all
    notice = "stopping: each run ends at its next checkpoint; press again to stop immediately"  # printed on Ctrl-C
    waits_for_cancelled = True

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """See Hydra's Launcher.

        Raises:
          HydraException: a package or a service that it needs is not available.
        """
        del hydra_context, task_function  # each run composes its own config
        self.config = config
        try:
            self._package = importlib.import_module(self.package)
        except ImportError as error:
            raise HydraException(
                f"hydra/launcher={self.choice} needs the package {self.package}: "
                f"{install_command(self.extra)}; hydra/launcher={LOCAL} needs none"
            ) from error
        self.connect()

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Starts the runs, waits for all of them, and prints when each has ended.

        Raises:
          SystemExit: stopped by a signal.
        """
        commands = [self._command(list(overrides), initial_job_idx + i) for i, overrides in enumerate(job_overrides)]
        waiting, running = list(range(len(commands))), dict[int, tuple[int, Any]]()  # number to slot and job
        slots = list(range(self.max_parallel or len(commands)))
        outcomes: dict[int, Outcome] = {}
        signals = Signals()
        with noted_signals(signals, self.notice), exit_hook(lambda _: self._cancel(running)):
            while waiting or running:
                if signals.caught:
                    self._stop([job for _, job in running.values()], signals)
                started, waiting = waiting[: len(slots)], waiting[len(slots) :]
                taken, slots = slots[: len(started)], slots[len(started) :]
                jobs = self.start([commands[number] for number in started], taken) if started else []
                running |= dict(zip(started, zip(taken, jobs, strict=True), strict=True))
                for number, job in zip(started, jobs, strict=True):
                    print(f"run {initial_job_idx + number}: {self.name(job)}, log: {commands[number].log}", flush=True)
                for number, (slot, job) in list(running.items()):
                    if self.done(job):
                        del running[number]
                        slots.append(slot)
                        outcomes[number] = outcome = _outcome_of(lambda job=job: self.result(job))
                        status = f"failed: {outcome.reason}" if outcome.exit_code else "done"
                        print(f"run {initial_job_idx + number}: {status}", flush=True)
                time.sleep(_POLL_S)
        return [
            JobReturn(overrides=list(overrides), status=JobStatus.COMPLETED, _return_value=outcomes[number])
            for number, overrides in enumerate(job_overrides)
        ]

    def _cancel(self, running: Mapping[int, tuple[int, Any]]) -> None:
        for _, job in list(running.values()):
            self.cancel(job)

    def _stop(self, running: Sequence[Any], signals: Signals) -> None:
        for job in running:
            self.cancel(job)
        while self.waits_for_cancelled and not all(self.done(job) for job in running):
            time.sleep(_POLL_S)
        sys.exit(signals.exit_code)

    def _command(self, overrides: list[str], number: int) -> RunCommand:
        hydra = self.config.hydra
        logs = Path(hydra.sweep.dir) / LOGS
        logs.mkdir(exist_ok=True)
        sources = [source.path for source in hydra.runtime.config_sources if source.provider == "command-line"]
        options = [f"--config-name={hydra.job.config_name}", *(f"--config-dir={path}" for path in sources)]
        run_dir = next((path_of(o) for o in reversed(overrides) if o.startswith(("run_dir=", "resume="))), "")
        return RunCommand(
            module=hydra.help.app_name,
            arguments=[*options, *overrides],
            folder=str(Path.cwd()),
            log=str(logs / f"{Path(run_dir).name or number}.log"),
            run_dir=run_dir,
        )

    def connect(self) -> None:
        """Connects to the service that runs jobs; raises a HydraException if it is not available."""

    @abstractmethod
    def start(self, commands: Sequence[RunCommand], slots: Sequence[int]) -> Sequence[Any]:
        """Starts one run in each slot and returns their jobs."""

    @abstractmethod
    def done(self, job: Any) -> bool:
        """Whether a job has ended."""

    @abstractmethod
    def result(self, job: Any) -> Outcome:
        """Outcome of a job that has ended; raises the service's error for a job that it lost."""

    @abstractmethod
    def cancel(self, job: Any) -> None:
        """Asks the run to stop at its next checkpoint."""

    @abstractmethod
    def name(self, job: Any) -> str:
        """Name of a job in the service."""


def _outcome_of(result: Callable[[], Outcome]) -> Outcome:
    try:
        return result()
    except Exception as error:  # each service has its own exceptions
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        return Outcome(FAILED, f"{type(error).__name__}: {lines[0] if lines else 'no reason given'}")
