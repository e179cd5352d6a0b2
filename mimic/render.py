"""`python -m mimic.render run=DIR`: a video of expert and learner: a policy, a pose mapper, or retargeted motions."""

from mimic import cli, compat
from mimic.commands.config import RenderConfig


def prepare(config: RenderConfig) -> cli.Work:
    """The video that the config describes."""
    compat.import_mjx()
    from mimic.commands import render  # not needed for --help

    return render.prepare_video(config)


if __name__ == "__main__":
    cli.run(prepare, "render")
