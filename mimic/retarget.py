"""`python -m mimic.retarget source=DATA expert=ARM learner=ARM out=DIR`: a data set of one arm for another."""

from mimic.commands import cli
from mimic.commands.config import RetargetConfig


def prepare(config: RetargetConfig) -> cli.Work:
    """Prepares a retargeting. See `mimic.commands.retarget`."""
    from mimic.commands import retarget  # slow to import, and not needed for --help

    return retarget.prepare_retargeting(config)


if __name__ == "__main__":
    cli.run(prepare, "retarget")
