"""`python -m mimic.collect DIR`: collects runs in one table and plot, with confidence intervals over seeds."""

from mimic.commands import cli
from mimic.commands.config import CollectConfig


def prepare(config: CollectConfig) -> cli.Work:
    """Prepares a collection of runs. See `mimic.commands.collect.collect`."""
    from mimic.commands.collect import collect  # slow to import, and not needed for --help

    return collect.prepare_collection(config)


if __name__ == "__main__":
    cli.run(prepare, "collect")
