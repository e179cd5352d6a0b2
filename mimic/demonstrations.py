"""`python -m mimic.demonstrations out=FILE.npz`: records an expert with its torques, or imports motions."""

from mimic.commands import cli
from mimic.commands.config import RecordingConfig


def prepare(config: RecordingConfig) -> cli.Work:
    """Prepares a recording of demonstrations. See `mimic.commands.demonstrations`."""
    from mimic.commands import demonstrations  # slow to import, and not needed for --help

    return demonstrations.prepare_recording(config)


if __name__ == "__main__":
    cli.run(prepare, "demonstrations")
