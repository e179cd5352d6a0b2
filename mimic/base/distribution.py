"""The distribution: how package indexes name it, and its version. Its modules are imported as `mimic`."""

NAME = "mimic-arms"
VERSION = "0.1.0"


def install_command(extra: str) -> str:
    """The command that installs mimic with the packages of an extra."""
    return f"pip install '{NAME}[{extra}]'"
