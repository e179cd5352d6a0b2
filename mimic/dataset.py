"""`python -m mimic.dataset run=DIR out=DIR`: writes rollouts or demonstrations as a LeRobot dataset or as rosbag2."""

from mimic.base import compat
from mimic.commands import cli
from mimic.commands.config import DatasetConfig


def prepare(config: DatasetConfig) -> cli.Work:
    """Prepares a dataset. See `mimic.commands.dataset`."""
    compat.import_mjx()
    from mimic.commands import dataset  # slow to import, and not needed for --help

    return dataset.prepare_dataset(config)


if __name__ == "__main__":
    cli.run(prepare, "dataset")
