"""`python -m mimic.train`: trains, evaluates and reports one run."""

import time

_STARTED = time.perf_counter()

import sys  # noqa: E402

from mimic import cli, compat  # noqa: E402
from mimic.trainers.config import TrainConfig  # noqa: E402


def main(config: TrainConfig) -> None:
    """Runs what the config says."""
    compat.import_mjx()
    from mimic.trainers import session  # brax and MJX: not needed for --help

    exit_code = session.train(config, _STARTED, cli.overrides())
    if exit_code:
        sys.exit(exit_code)


if __name__ == "__main__":
    cli.run(main, "train")
