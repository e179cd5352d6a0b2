"""`python -m mimic.view`: expert and learner live in the browser."""

from mimic import cli
from mimic.commands.config import ViewConfig


def prepare(config: ViewConfig) -> cli.Work:
    """The viewer that the config describes."""
    from mimic.commands import view  # not needed for --help

    return view.prepare_view(config)


if __name__ == "__main__":
    cli.run(prepare, "view")
