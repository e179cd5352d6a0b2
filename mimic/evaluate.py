"""`python -m mimic.evaluate run=DIR`: repeats the report of a run from a checkpoint alone."""

import time

_STARTED = time.perf_counter()

from mimic import cli  # noqa: E402
from mimic.trainers.config import EvaluateConfig  # noqa: E402


def prepare(config: EvaluateConfig) -> cli.Work:
    """The evaluation that the config describes."""
    from mimic.trainers import session  # not needed for --help

    return session.prepare_evaluation(config, _STARTED)


if __name__ == "__main__":
    cli.run(prepare, "evaluate")
