"""`python -m mimic.export run=DIR out=FILE`: a trained policy or pose mapper as ONNX, or as StableHLO for JAX."""

from mimic import cli, compat
from mimic.commands.config import ExportConfig


def prepare(config: ExportConfig) -> cli.Work:
    """The export that the config describes."""
    compat.import_mjx()
    from mimic.commands import export  # not needed for --help

    return export.prepare_export(config)


if __name__ == "__main__":
    cli.run(prepare, "export")
