"""`python -m mimic.evaluate run=DIR`: repeats the report of a run from a checkpoint alone."""

import time

_STARTED = time.perf_counter()

from mimic import cli, compat  # noqa: E402
from mimic.trainers.config import EvaluateConfig  # noqa: E402


def main(config: EvaluateConfig) -> None:
    """Runs what the config says."""
    compat.import_mjx()
    from mimic.trainers import session  # brax and MJX: not needed for --help

    session.evaluate(config, _STARTED)


if __name__ == "__main__":
    cli.run(main, "evaluate")
