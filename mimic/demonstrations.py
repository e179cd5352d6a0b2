"""`python -m mimic.demonstrations kind=pd count=124 out=FILE.npz`: demonstrations of an expert, with their torques."""

from mimic import cli
from mimic.commands.config import RecordingConfig


def prepare(config: RecordingConfig) -> cli.Work:
    """The recording that the config describes."""
    from mimic.commands import demonstrations  # not needed for --help

    return demonstrations.prepare_recording(config)


if __name__ == "__main__":
    cli.run(prepare, "demonstrations")
