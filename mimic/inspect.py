"""`python -m mimic.inspect ARM.xml`: inspects an arm before training: joints, links, limits and kinematic bound."""

from mimic import cli, compat
from mimic.commands.config import InspectConfig


def prepare(config: InspectConfig) -> cli.Work:
    """Prepares an inspection, see `mimic.commands.inspect`, or a replay, see `mimic.commands.inspect_divergence`."""
    if config.divergence:
        compat.import_mjx()
        from mimic.commands import inspect_divergence

        return inspect_divergence.prepare_replay(config)
    from mimic.commands import inspect  # slow to import, and not needed for --help

    return inspect.prepare_inspection(config)


if __name__ == "__main__":
    cli.run(prepare, "inspect")
