"""`python -m mimic.inspect ARM.xml`: inspects an arm before training: joints, links, limits and kinematic bound."""

from mimic.commands import cli
from mimic.commands.config import InspectConfig


def prepare(config: InspectConfig) -> cli.Work:
    """Prepares an inspection, see `mimic.commands.inspect`."""
    if config.clip:
        from pathlib import Path

        from mimic.commands.capture import prepare_capture_inspection

        return prepare_capture_inspection(Path(config.clip).expanduser(), config.capture)
    from mimic.commands import inspect  # slow to import, and not needed for --help

    return inspect.prepare_inspection(config)


if __name__ == "__main__":
    cli.run(prepare, "inspect")
