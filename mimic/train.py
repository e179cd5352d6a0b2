"""`python -m mimic.train`: trains, evaluates and reports one run."""

import time

_process_started = [time.perf_counter()]  # for the first job; those that follow in a sweep start when they start

from mimic import cli  # noqa: E402
from mimic.trainers.config import TrainConfig  # noqa: E402


def prepare(config: TrainConfig) -> cli.Work:
    """The run that the config describes."""
    began = time.perf_counter()
    from mimic.trainers import session  # not needed for --help

    started = _process_started.pop() if _process_started else began
    return session.prepare_training(config, started, cli.overrides())


if __name__ == "__main__":
    cli.run(prepare, "train")
