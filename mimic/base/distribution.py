"""The distribution: how package indexes name it, its version, and its extras. Its modules are imported as `mimic`."""

import importlib
from typing import Any

NAME = "mimic-arms"
VERSION = "0.1.0"


def install_command(extra: str) -> str:
    """The command that installs mimic with the packages of an extra."""
    return f"pip install '{NAME}[{extra}]'"


def import_extra(package: str, extra: str, what: str) -> Any:
    """Imports a package of an extra and returns it.

    Args:
      package: its name.
      extra: of mimic, which has it.
      what: needs it, as the beginning of the message.

    Raises:
      ValueError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ValueError(f"{what} needs the package {package}: {install_command(extra)}") from error
