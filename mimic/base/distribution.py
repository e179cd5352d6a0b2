"""The distribution: how package indexes name it, and its version. Its modules are imported as `mimic`."""

from collections.abc import Mapping
from typing import Any

NAME = "mimic-arms"
VERSION = "0.1.0"
_FORMER_NAMES = ("mimic-mjx",)  # keys of the version in reports of earlier runs; it is the name of another project


def install_command(extra: str) -> str:
    """The command that installs mimic with the packages of an extra."""
    return f"pip install '{NAME}[{extra}]'"


def recorded_version(versions: Mapping[str, Any]) -> str:
    """The version of mimic among the versions that a run has recorded; "unknown" where there is none."""
    return str(next((versions[name] for name in (NAME, *_FORMER_NAMES) if name in versions), "unknown"))
