"""Commands that run in the process of the tests: starting Python and importing JAX takes seconds."""

import contextlib
import functools
import importlib
import io
import sys
from pathlib import Path
from typing import Any

import hydra
import pytest

from mimic.base.config import schema, typed
from mimic.commands import cli

schemas = functools.cache(schema)  # once for each class: a third of the time of a command


def run(name: str, *arguments: Any, folder: Path | None = None) -> str:
    """Runs a command, in a folder, and returns what it prints."""
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(cli, "schema", schemas)
        patch.setattr(sys, "argv", [f"mimic.{name}", *map(str, arguments)])
        if folder is not None:
            patch.chdir(folder)
        cli.run(importlib.import_module(f"mimic.{name}").prepare, name)
    return printed.getvalue()


def compose(name: str, *arguments: str) -> Any:
    """The typed config of a command's arguments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "schema", schemas)
        cli.register()
    with hydra.initialize_config_module("mimic.conf", version_base="1.3"):
        return typed(hydra.compose(name, cli.expand_arguments(list(arguments), name)))
