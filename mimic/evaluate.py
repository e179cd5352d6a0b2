"""`python -m mimic.evaluate run=DIR`: repeats the report of a run from a checkpoint alone."""

from mimic import cli
from mimic.commands.config import EvaluateConfig


def prepare(config: EvaluateConfig) -> cli.Work:
    """The evaluation that the config describes."""
    cli.start_backend()
    from mimic.commands.evaluate import prepare_evaluation  # not needed for --help

    return prepare_evaluation(config, cli.process_started())


if __name__ == "__main__":
    cli.run(prepare, "evaluate")
