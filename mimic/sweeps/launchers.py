"""Where the runs of a sweep run: processes of this machine, jobs of Slurm, tasks of Ray; choices of hydra/launcher.

Hydra's plugins for these are not used: that for submitit has had no release since 2022, that for Ray holds cloudpickle
below 3 and brings boto3, and both pickle Hydra's state.
"""

import contextlib
import dataclasses
import os
import shutil
import signal
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra.errors import HydraException
from omegaconf import OmegaConf

from mimic.sweeps.hydra_plugins import register, target
from mimic.sweeps.launcher import LOCAL, CommandLauncher
from mimic.sweeps.run_command import RunCommand
from mimic.sweeps.sweeper import Outcome

_GPUS = "CUDA_VISIBLE_DEVICES"
_NO_TIMEOUT_MIN = 365 * 24 * 60  # submitit wants one
_ANSWER_S = 10


@dataclasses.dataclass
class SubmititLocalConf:
    """Processes of this machine.

    Attributes:
      parallel: runs at once.
      gpus_per_run: how many GPUs each run has to itself; all see all GPUs where None.
    """

    _target_: str = target("SubmititLocalLauncher")
    parallel: int = 1
    gpus_per_run: int | None = None


@dataclasses.dataclass
class SubmititSlurmConf:
    """Jobs of Slurm, as one array: see sbatch.

    Attributes:
      partition, account, qos, constraint: where, and on whose account.
      gpus_per_node, cpus_per_task, mem_gb: what each run gets.
      timeout_min: time limit [min]; a run that reaches it is queued again and goes on from its checkpoint.
      signal_delay_s: before the limit, when the run is told to stop [s].
      max_num_timeout: how often it goes on so.
      array_parallelism: runs at once.
      setup: shell commands before each run, as `module load cuda`.
      additional_parameters: other options of sbatch, by their names.
    """

    _target_: str = target("SubmititSlurmLauncher")
    partition: str | None = None
    account: str | None = None
    qos: str | None = None
    constraint: str | None = None
    gpus_per_node: int | None = 1  # without one a run would train on the CPU, and say so in its report alone
    cpus_per_task: int = 8
    mem_gb: float | None = None
    timeout_min: int = 60
    signal_delay_s: int = 120
    max_num_timeout: int = 3
    array_parallelism: int = 256
    setup: list[str] | None = None
    additional_parameters: dict[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass
class RayConf:
    """Tasks of Ray.

    Attributes:
      address: of a cluster, or "auto" for the one that this machine is in; Ray starts on this machine alone where None.
      num_cpus: that Ray counts for each run.
      num_gpus: that each run has to itself; without one it sees none.
    """

    _target_: str = target("RayLauncher")
    address: str | None = None
    num_cpus: float = 1
    num_gpus: float = 0


class _SubmititLauncher(CommandLauncher):
    extra, package = "slurm", "submitit"
    cluster: str

    def executor(self, **settings: Any) -> Any:
        """That takes jobs."""
        folder = Path(self.config.hydra.sweep.dir).absolute() / ".submitit"
        executor = self._package.AutoExecutor(folder=folder, cluster=self.cluster, **settings)
        executor.update_parameters(name="mimic")
        return executor

    def done(self, job: Any) -> bool:
        """As submitit sees it."""
        return job.done()

    def result(self, job: Any) -> Outcome:
        """What the run returned, through a file."""
        return job.result()


class SubmititLocalLauncher(_SubmititLauncher):
    """Through submitit, as on Slurm, but on this machine."""

    choice = "submitit_local"
    cluster = "local"

    def __init__(self, parallel: int, gpus_per_run: int | None):
        self.room, self._gpus_per_run = parallel, gpus_per_run

    def connect(self) -> None:
        """Checks that there is room for a run, and a GPU for each if they shall have one."""
        if self.room is None or self.room < 1:
            raise HydraException(f"hydra.launcher.parallel: expected at least 1, got {self.room}")
        gpus_of(self.room - 1, self._gpus_per_run, os.environ.get(_GPUS))

    def start(self, commands: Sequence[RunCommand], slots: Sequence[int]) -> list[Any]:
        """Each as a process that submitit watches."""
        known, executor = os.environ.get(_GPUS), self.executor()
        executor.update_parameters(timeout_min=_NO_TIMEOUT_MIN)
        for command, slot in zip(commands, slots, strict=True):
            command.environment[_GPUS] = gpus_of(slot, self._gpus_per_run, known)  # submitit would hide them
        with _interrupts_ignored():  # by what is started: Ctrl-C reaches all processes of a terminal
            return [executor.submit(command) for command in commands]

    def cancel(self, job: Any) -> None:
        """By SIGTERM; the way of submitit itself kills after a second."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(job.job_id), signal.SIGTERM)

    def name(self, job: Any) -> str:
        """By the process that watches it."""
        return f"process {job.job_id}"


class SubmititSlurmLauncher(_SubmititLauncher):
    """Through submitit, as one job array. The jobs do not need the process that queued them."""

    choice = "submitit_slurm"
    cluster = "slurm"
    notice = "no longer waiting; the jobs stay with Slurm, and scancel ends them"
    waits_for_cancelled = False

    def __init__(self, max_num_timeout: int, **settings: Any):
        self._max_num_timeout = max_num_timeout
        plain = {key: OmegaConf.to_container(x) if OmegaConf.is_config(x) else x for key, x in settings.items()}
        shared = ("timeout_min", "gpus_per_node", "cpus_per_task", "mem_gb")  # which submitit gives all clusters
        self._settings = {
            key if key in shared else f"slurm_{key}": value for key, value in plain.items() if value is not None
        }

    def connect(self) -> None:
        """Checks that this machine can queue jobs."""
        if not shutil.which("sbatch"):
            raise HydraException(
                f"hydra/launcher={self.choice}: expected a machine with Slurm's sbatch, got none; "
                f"hydra/launcher={SubmititLocalLauncher.choice} needs none"
            )

    def start(self, commands: Sequence[RunCommand], slots: Sequence[int]) -> list[Any]:
        """All as one array."""
        del slots
        executor = self.executor(slurm_max_num_timeout=self._max_num_timeout)
        executor.update_parameters(**self._settings)
        with executor.batch():
            return [executor.submit(command) for command in commands]

    def cancel(self, job: Any) -> None:
        """Not: that is for scancel."""
        del job

    def name(self, job: Any) -> str:
        """By its number in the queue."""
        return f"job {job.job_id}"


class RayLauncher(CommandLauncher):
    """As tasks of Ray, which gives each its GPUs and lets the others wait."""

    choice, extra, package = "ray", "ray", "ray"

    def __init__(self, address: str | None, num_cpus: float, num_gpus: float):
        self._address = address
        self._resources = {"num_cpus": num_cpus, "num_gpus": num_gpus}

    def connect(self) -> None:
        """Joins the cluster, or starts Ray on this machine."""
        started = {} if self._address else {"include_dashboard": False}
        try:
            _check_port(self._address or "")
            self._package.init(self._address, log_to_driver=False, logging_level="ERROR", **started)
        except (OSError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())[:200]
            raise HydraException(f"hydra.launcher.address={self._address}: no Ray found: {reason}") from error

    def start(self, commands: Sequence[RunCommand], slots: Sequence[int]) -> list[Any]:
        """All at once; Ray lets them wait for what they need."""
        del slots
        # A task that dies is not run again: its run directory is there.
        run = self._package.remote(max_retries=0, **self._resources)(_call)
        return [run.remote(command) for command in commands]

    def done(self, job: Any) -> bool:
        """Whether there is a result."""
        return bool(self._package.wait([job], timeout=0)[0])

    def result(self, job: Any) -> Outcome:
        """What the run returned."""
        return self._package.get(job)

    def cancel(self, job: Any) -> None:
        """By a KeyboardInterrupt in the task."""
        self._package.cancel(job, force=False)

    def name(self, job: Any) -> str:
        """By Ray's number."""
        return f"task {job.task_id().hex()}"


def _check_port(address: str) -> None:
    """Raises an OSError where nobody listens at HOST:PORT; Ray would go on trying for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), timeout=_ANSWER_S).close()


def _call(command: RunCommand) -> Outcome:
    return command()


def gpus_of(slot: int, count: int | None, known: str | None) -> str | None:
    """The GPUs of a slot, as CUDA_VISIBLE_DEVICES.

    Args:
      slot: from 0.
      count: GPUs of each slot; all see what this process sees where None.
      known: CUDA_VISIBLE_DEVICES of this process, which sees all GPUs where None.

    Raises:
      HydraException: this process does not see as many.
    """
    if count is None:
        return known
    needed = range(slot * count, (slot + 1) * count)
    if known is None:
        return ",".join(map(str, needed))
    names = [name for name in known.split(",") if name]
    if needed.stop > len(names):
        raise HydraException(
            f"hydra.launcher.parallel: {slot + 1} runs with {count} GPUs each need {needed.stop}, got {len(names)}: "
            f"{_GPUS}={known}"
        )
    return ",".join(names[i] for i in needed)


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def check_launcher(choice: str) -> None:
    """Raises a ValueError for a launcher of sweeps that a single run was given: Hydra would not use it, nor say so."""
    if choice != LOCAL:
        raise ValueError(f"hydra/launcher={choice}: expected with a sweep alone; add -m to launch this run through it")


_CONFIGS = {
    SubmititLocalLauncher: SubmititLocalConf,
    SubmititSlurmLauncher: SubmititSlurmConf,
    RayLauncher: RayConf,
}


def register_launchers() -> None:
    """Makes them choices of hydra/launcher."""
    for launcher, config in _CONFIGS.items():
        register(launcher, config, "hydra/launcher", launcher.choice)
