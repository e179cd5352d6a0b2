"""`python -m mimic.render run=DIR`: renders a video of expert and learner."""

from mimic.base import compat
from mimic.commands import cli
from mimic.commands.config import RenderConfig


def prepare(config: RenderConfig) -> cli.Work:
    """Prepares a video. See `mimic.commands.render`."""
    compat.import_mjx()
    from mimic.commands import render  # slow to import, and not needed for --help

    return render.prepare_video(config)


if __name__ == "__main__":
    cli.run(prepare, "render")
