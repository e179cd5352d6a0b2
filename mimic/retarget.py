"""`python -m mimic.retarget demonstrations=FILE learner=ENV out=FILE`: an expert's motions as a learner's."""

from mimic import cli
from mimic.envs.config import RetargetConfig


def main(config: RetargetConfig) -> None:
    """Runs what the config says."""
    from mimic.envs import retargeting  # not needed for --help

    retargeting.retarget_file(config)


if __name__ == "__main__":
    cli.run(main, "retarget")
