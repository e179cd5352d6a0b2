"""`python -m mimic.collect DIR`: the runs below a folder as one table and figure, with confidence intervals."""

from mimic import cli
from mimic.commands.config import CollectConfig


def prepare(config: CollectConfig) -> cli.Work:
    """The collection that the config describes."""
    from mimic.commands import collect  # not needed for --help

    return collect.prepare_collection(config)


if __name__ == "__main__":
    cli.run(prepare, "collect")
