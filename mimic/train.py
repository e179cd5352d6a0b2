"""`python -m mimic.train`: trains an arm to imitate another arm, evaluates it and writes a run directory."""

import time

from mimic.commands import cli
from mimic.runs.distributed.process_group import join
from mimic.runs.signals import Signals
from mimic.trainers.config import TrainConfig

_process_started = [cli.process_started()]  # start time of the first run; later runs of a sweep start in `prepare`


def prepare(config: TrainConfig) -> cli.Work:
    """Prepares a training run. See `mimic.trainers.run_training`."""
    prepare_started = time.perf_counter()
    if config.distributed.coordinator and cli.is_sweep():
        raise ValueError("distributed: expected one run, got a sweep; start each of its runs as a command of its own")
    group = join(config.distributed)
    cli.start_backend()
    from mimic.trainers import run_training as train  # slow to import, and not needed for --help

    started = _process_started.pop() if _process_started else prepare_started
    signals = group.signals if group else Signals()
    work = train.prepare_training(config, started, cli.overrides(), group, signals)
    if group:
        return lambda: group.run(work)
    # A signal during the final report does not change the exit code of this run, but it ends a sweep.
    return (lambda: work() or signals.exit_code) if cli.is_sweep() else work


if __name__ == "__main__":
    cli.run(prepare, "train")
