"""`python -m mimic.inspect ARM.xml`: what an arm's file holds, whether it can be trained, and how near it can come."""

from mimic import cli
from mimic.commands.config import InspectConfig


def prepare(config: InspectConfig) -> cli.Work:
    """The inspection that the config describes."""
    from mimic.commands import inspect  # not needed for --help

    return inspect.prepare_inspection(config)


if __name__ == "__main__":
    cli.run(prepare, "inspect")
