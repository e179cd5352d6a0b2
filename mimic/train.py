"""`python -m mimic.train`: trains, evaluates and reports one run."""

import time

from mimic import cli
from mimic.runs.signals import Signals
from mimic.trainers.config import TrainConfig
from mimic.trainers.distributed.process_group import join

_process_started = [cli.process_started()]  # for the first job; those that follow in a sweep start when they start


def prepare(config: TrainConfig) -> cli.Work:
    """The run that the config describes."""
    began = time.perf_counter()
    if config.distributed.coordinator and cli.is_sweep():
        raise ValueError("distributed: expected one run, got a sweep; start each of its runs by itself")
    group = join(config.distributed)
    cli.start_backend()
    from mimic.commands import train  # not needed for --help

    started = _process_started.pop() if _process_started else began
    signals = group.signals if group else Signals()
    work = train.prepare_training(config, started, cli.overrides(), group, signals)
    # One that came while the report was made changed nothing for this run, but a sweep ends by it.
    return (lambda: work() or signals.exit_code) if cli.is_sweep() else work


if __name__ == "__main__":
    cli.run(prepare, "train")
