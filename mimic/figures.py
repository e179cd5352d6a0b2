"""`python -m mimic.figures out=DIR`: figures of the metric and of static pose imitation, from our own runs."""

from mimic import cli
from mimic.commands.config import FiguresConfig


def prepare(config: FiguresConfig) -> cli.Work:
    """The figures that the config describes."""
    from mimic.commands import figures  # not needed for --help

    return figures.prepare_figures(config)


if __name__ == "__main__":
    cli.run(prepare, "figures")
