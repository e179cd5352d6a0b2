"""`python -m mimic.evaluate run=DIR`: evaluates a trained policy, or another controller in its place."""

from mimic.commands import cli
from mimic.commands.config import EvaluateConfig


def prepare(config: EvaluateConfig) -> cli.Work:
    """Prepares an evaluation. See `mimic.commands.evaluate`."""
    cli.start_backend()
    from mimic.commands.evaluate import prepare_evaluation  # slow to import, and not needed for --help

    return prepare_evaluation(config, cli.process_started())


if __name__ == "__main__":
    cli.run(prepare, "evaluate")
