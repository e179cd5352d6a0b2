"""`python -m mimic.export run=DIR out=FILE`: exports a policy or pose mapper to ONNX."""

from mimic.base import compat
from mimic.commands import cli
from mimic.trainers.export.config import ExportConfig


def prepare(config: ExportConfig) -> cli.Work:
    """Prepares an export. See `mimic.trainers.export.export`."""
    compat.import_mjx()
    from mimic.trainers.export import export  # slow to import, and not needed for --help

    return export.prepare_export(config)


if __name__ == "__main__":
    cli.run(prepare, "export")
