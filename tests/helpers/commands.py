"""Commands, in the process of the tests, as starting Python and importing JAX takes seconds; or in their own."""

import contextlib
import functools
import importlib
import io
import socket
import subprocess
import sys
import time
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


def command(name: str, *arguments: Any, **more: Any) -> subprocess.CompletedProcess[str]:
    """Runs a command in a process of its own."""
    words = [sys.executable, "-m", f"mimic.{name}", *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, timeout=800, check=False, **more)


def start(name: str, *arguments: Any, **more: Any) -> subprocess.Popen[str]:
    """Starts a command in a process of its own."""
    words = [sys.executable, "-m", f"mimic.{name}", *map(str, arguments)]
    return subprocess.Popen(words, **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **more})


def free_port() -> int:
    """A port of this machine that no process listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(folder: Path, pattern: str, *processes: subprocess.Popen[str], count: int = 1) -> None:
    """Waits until files of running processes exist."""
    until = time.monotonic() + 200
    while time.monotonic() < until and len(list(folder.glob(pattern))) < count:
        for process in processes:
            assert process.poll() is None, process.communicate()
        time.sleep(0.2)


def compose(name: str, *arguments: str) -> Any:
    """The typed config of a command's arguments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "schema", schemas)
        cli.register()
    with hydra.initialize_config_module("mimic.conf", version_base="1.3"):
        return typed(hydra.compose(name, cli.expand_arguments(list(arguments), name)))
