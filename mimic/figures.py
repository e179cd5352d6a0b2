"""`python -m mimic.figures out=DIR`: draws the figures of the metric and of pose retargeting."""

from mimic.commands import cli
from mimic.commands.config import FiguresConfig


def prepare(config: FiguresConfig) -> cli.Work:
    """Prepares the figures. See `mimic.commands.figures`."""
    from mimic.commands import figures  # slow to import, and not needed for --help

    return figures.prepare_figures(config)


if __name__ == "__main__":
    cli.run(prepare, "figures")
