"""`python -m mimic.retarget demonstrations=FILE learner=ENV out=FILE`: an expert's motions as a learner's."""

from mimic import cli
from mimic.commands.config import RetargetConfig


def prepare(config: RetargetConfig) -> cli.Work:
    """The retargeting that the config describes."""
    from mimic.commands import retarget  # not needed for --help

    return retarget.prepare_retargeting(config)


if __name__ == "__main__":
    cli.run(prepare, "retarget")
