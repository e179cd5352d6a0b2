"""Launchers of sweeps (choices of hydra/launcher): processes of this machine, Slurm jobs, Ray tasks.

Hydra's plugins for these are not used: the one for submitit has had no release since 2022, the one for Ray requires
cloudpickle below 3 and boto3, and both pickle Hydra's state.
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

from mimic.base.ranges import Range
from mimic.runs.sweeps.hydra_plugins import register, target
from mimic.runs.sweeps.launcher import LOCAL, CommandLauncher
from mimic.runs.sweeps.run_command import RunCommand
from mimic.runs.sweeps.sweeper import MAX_RUNS, Outcome

_GPUS = "CUDA_VISIBLE_DEVICES"
_NO_TIMEOUT_MIN = 365 * 24 * 60  # submitit requires a time limit
_CONNECT_TIMEOUT_S = 10
_PARALLEL = Range(1, MAX_RUNS)  # more processes than runs have nothing to do


@dataclasses.dataclass
class SubmititLocalConf:
    """Processes of this machine.

    Attributes:
      parallel: maximum number of runs in parallel.
      gpus_per_run: number of GPUs reserved for each run. Default None: every run sees all GPUs.
    """

    _target_: str = target("SubmititLocalLauncher")
    parallel: int = 1
    gpus_per_run: int | None = None


@dataclasses.dataclass
class SubmititSlurmConf:
    """Jobs of Slurm, as one job array; see sbatch.

    Attributes:
      partition, account, qos, constraint: options of sbatch.
      gpus_per_node, cpus_per_task, mem_gb: resources of each run.
      timeout_min: time limit [min]; a run that reaches it is queued again and resumes from its checkpoint.
      signal_delay_s: time before the limit at which the run is stopped [s].
      max_num_timeout: maximum number of times that a run is queued again.
      array_parallelism: maximum number of runs in parallel.
      setup: shell commands before each run, such as `module load cuda`.
      additional_parameters: other options of sbatch by name.
    """

    _target_: str = target("SubmititSlurmLauncher")
    partition: str | None = None
    account: str | None = None
    qos: str | None = None
    constraint: str | None = None
    gpus_per_node: int | None = 1  # with None, a run would train on the CPU, which only its report shows
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
      address: address of a cluster, or "auto" for that of this machine. Default None: Ray starts on this machine.
      num_cpus: CPUs reserved for each run.
      num_gpus: GPUs reserved for each run; with 0 it sees none.
    """

    _target_: str = target("RayLauncher")
    address: str | None = None
    num_cpus: float = 1
    num_gpus: float = 0


class _SubmititLauncher(CommandLauncher):
    extra, package = "slurm", "submitit"
    cluster: str

    def executor(self, **settings: Any) -> Any:
        """The executor of submitit that jobs are submitted to."""
        folder = Path(self.config.hydra.sweep.dir).absolute() / ".submitit"
        executor = self._package.AutoExecutor(folder=folder, cluster=self.cluster, **settings)
        executor.update_parameters(name="mimic")
        return executor

    def done(self, job: Any) -> bool:
        """Whether submitit considers the job ended."""
        return job.done()

    def result(self, job: Any) -> Outcome:
        """Outcome of the run, which submitit passes through a file."""
        return job.result()


class SubmititLocalLauncher(_SubmititLauncher):
    """Launches runs as processes of this machine, through submitit."""

    choice = "submitit_local"
    cluster = "local"

    def __init__(self, parallel: int, gpus_per_run: int | None):
        self.max_parallel, self._gpus_per_run = parallel, gpus_per_run

    def connect(self) -> None:
        """Checks the number of parallel runs, and that there are enough GPUs for them."""
        try:
            _PARALLEL.check("hydra.launcher.parallel", self.max_parallel)
        except ValueError as error:
            raise HydraException(str(error)) from error
        assert self.max_parallel is not None
        gpus_of(self.max_parallel - 1, self._gpus_per_run, os.environ.get(_GPUS))

    def start(self, commands: Sequence[RunCommand], slots: Sequence[int]) -> list[Any]:
        """Starts each run as a process that submitit monitors."""
        visible, executor = os.environ.get(_GPUS), self.executor()
        executor.update_parameters(timeout_min=_NO_TIMEOUT_MIN)
        for command, slot in zip(commands, slots, strict=True):
            command.environment[_GPUS] = gpus_of(slot, self._gpus_per_run, visible)  # else submitit hides them
        with _interrupts_ignored():  # in the started processes: Ctrl-C reaches all processes of a terminal
            return [executor.submit(command) for command in commands]

    def cancel(self, job: Any) -> None:
        """Sends SIGTERM; submitit's own method kills the process after a second."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(job.job_id), signal.SIGTERM)

    def name(self, job: Any) -> str:
        """The process that monitors the run."""
        return f"process {job.job_id}"


class SubmititSlurmLauncher(_SubmititLauncher):
    """Launches runs as one Slurm job array, through submitit. The jobs outlive the process that queued them."""

    choice = "submitit_slurm"
    cluster = "slurm"
    notice = "no longer waiting; the jobs stay in Slurm, and scancel ends them"
    waits_for_cancelled = False

    def __init__(self, max_num_timeout: int, **settings: Any):
        self._max_num_timeout = max_num_timeout
        plain = {key: OmegaConf.to_container(x) if OmegaConf.is_config(x) else x for key, x in settings.items()}
        shared = (
            "timeout_min",
            "gpus_per_node",
            "cpus_per_task",
            "mem_gb",
        )  # names without the prefix slurm_ in submitit
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
        """Submits all runs as one job array."""
        del slots
        executor = self.executor(slurm_max_num_timeout=self._max_num_timeout)
        executor.update_parameters(**self._settings)
        with executor.batch():
            return [executor.submit(command) for command in commands]

    def cancel(self, job: Any) -> None:
        """Does nothing: scancel ends jobs of Slurm."""
        del job

    def name(self, job: Any) -> str:
        """The job number in Slurm."""
        return f"job {job.job_id}"


class RayLauncher(CommandLauncher):
    """Launches runs as Ray tasks; Ray assigns their GPUs and queues the others."""

    choice, extra, package = "ray", "ray", "ray"

    def __init__(self, address: str | None, num_cpus: float, num_gpus: float):
        self._address = address
        self._resources = {"num_cpus": num_cpus, "num_gpus": num_gpus}

    def connect(self) -> None:
        """Connects to the cluster, or starts Ray on this machine."""
        options = {} if self._address else {"include_dashboard": False}
        try:
            _check_port(self._address or "")
            self._package.init(self._address, log_to_driver=False, logging_level="ERROR", **options)
        except (OSError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())[:200]
            raise HydraException(f"hydra.launcher.address={self._address}: no Ray found: {reason}") from error

    def start(self, commands: Sequence[RunCommand], slots: Sequence[int]) -> list[Any]:
        """Starts all tasks; Ray queues them until their resources are free."""
        del slots
        # A task that dies is not retried: its run directory exists already.
        run = self._package.remote(max_retries=0, **self._resources)(_call)
        return [run.remote(command) for command in commands]

    def done(self, job: Any) -> bool:
        """Whether the task has a result."""
        return bool(self._package.wait([job], timeout=0)[0])

    def result(self, job: Any) -> Outcome:
        """Outcome of the run."""
        return self._package.get(job)

    def cancel(self, job: Any) -> None:
        """Raises a KeyboardInterrupt in the task."""
        self._package.cancel(job, force=False)

    def name(self, job: Any) -> str:
        """The task id in Ray."""
        return f"task {job.task_id().hex()}"


def _check_port(address: str) -> None:
    """Raises an OSError if no server listens at HOST:PORT; Ray would retry for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), timeout=_CONNECT_TIMEOUT_S).close()


def _call(command: RunCommand) -> Outcome:
    return command()


def gpus_of(slot: int, count: int | None, visible: str | None) -> str | None:
    """The GPUs of a slot, as CUDA_VISIBLE_DEVICES.

    Args:
      slot: index of the slot, from 0.
      count: number of GPUs of each slot; None: the GPUs visible to this process.
      visible: CUDA_VISIBLE_DEVICES of this process; None: all GPUs are visible.

    Raises:
      HydraException: not enough GPUs are visible.
    """
    if count is None:
        return visible
    indices = range(slot * count, (slot + 1) * count)
    if visible is None:
        return ",".join(map(str, indices))
    names = [name for name in visible.split(",") if name]
    if indices.stop > len(names):
        raise HydraException(
            f"hydra.launcher.parallel: {slot + 1} runs with {count} GPUs each need {indices.stop}, got {len(names)}: "
            f"{_GPUS}={visible}"
        )
    return ",".join(names[i] for i in indices)


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def check_launcher(choice: str) -> None:
    """Raises a ValueError for a sweep launcher in a single run, which Hydra would silently ignore."""
    if choice != LOCAL:
        raise ValueError(f"hydra/launcher={choice}: expected only with a sweep; add -m to launch this run with it")


_CONFIGS = {
    SubmititLocalLauncher: SubmititLocalConf,
    SubmititSlurmLauncher: SubmititSlurmConf,
    RayLauncher: RayConf,
}


def register_launchers() -> None:
    """Registers our launchers as choices of hydra/launcher."""
    for launcher, config in _CONFIGS.items():
        register(launcher, config, "hydra/launcher", launcher.choice)
