"""`python -m mimic.view`: shows expert and learner live in the browser."""

from mimic.commands import cli
from mimic.commands.config import ViewConfig


def prepare(config: ViewConfig) -> cli.Work:
    """Prepares a live view. See `mimic.commands.view`."""
    from mimic.commands import view  # slow to import, and not needed for --help

    return view.prepare_view(config, cli.overrides())


if __name__ == "__main__":
    cli.run(prepare, "view")
