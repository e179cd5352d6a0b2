"""What README.md, CONTRIBUTING.md and the pages in docs show: their blocks, and how each is checked and run.

Fences say what a block is. `bash`, or an indented block: commands. `python`: code, where all blocks of a page share
their names. A `title="FILE"` after the language: a file that the reader saves. Anything else (`text`): to be read.

Every command is checked: Hydra composes its config, argparse parses its arguments, make and pip know its targets and
extras. And a page is run, from top to bottom in an empty folder, but for what `NOT_RUN` names and for the block below
an invisible comment, the only mark there is:

    <!-- not run: needs two GPUs -->

What trains gets the arguments in `SMALL` before those of the page, and those in `SHORT` after them. `runs/NAME` is the
newest run; `runs/NAME/FILE` the newest that has the file; `runs/SWEEP` the newest sweep.
"""

import argparse
import importlib
import os
import pathlib
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from mimic.commands import cli
from mimic.runs.sweeps.sweeper import Sweeper
from tests.helpers.repository import CACHED, REPOSITORY

PAGES = [
    *(REPOSITORY / name for name in ("README.md", "CONTRIBUTING.md")),
    *sorted((REPOSITORY / "docs").glob("**/*.md")),
]

NOT_RUN = (
    "make",
    "pip",
    ".",
    "http.server",
    "mimic.view",
    "benchmarks.",
)  # installs, serves until it is stopped, measures for hours
SMALL = {
    "ppo": [
        *("env.horizon=5", "env.demonstrations.count=4", "env.demonstrations.held_out=2"),
        *("trainer.num_envs=64", "trainer.batch_size=32", "trainer.num_minibatches=4"),
        *("trainer.num_updates_per_batch=1", "trainer.hidden_layers=[16]", "trainer.evaluations=1"),
    ],
    "pose_mapper": [
        *("trainer.samples=256", "trainer.batch_size=128", "trainer.epochs=1", "trainer.hidden_layers=[8]"),
        *("trainer.held_out_poses=32", "trainer.evaluations=1", "trainer.validation_poses=32"),
    ],
    "demonstrations": ["env.horizon=5"],
    "figures": ["only=[links,weights]"],
}
SHORT = {"ppo": ["trainer.num_timesteps=5000"]}
RESUMED = ["trainer.num_timesteps=10000"]  # what a page resumes has not been interrupted
_LONGEST = 900  # seconds a command


class Block(NamedTuple):
    """A block of a page.

    Attributes:
      kind: "bash", "python", or another word after the fence.
      text: without fence or indent.
      title: of a file.
      is_run: False below the mark.
    """

    kind: str
    text: str
    title: str | None
    is_run: bool


def read_blocks(text: str) -> list[Block]:
    """The blocks of a page."""
    blocks: list[Block] = []
    lines = iter([*text.split("\n"), ""])
    before, is_marked = "", False
    for line in lines:
        fence = re.fullmatch(r'```(\w*)(?: title="(.+)")?', line)
        if fence:
            inside = list(iter(lambda: next(lines), "```"))
            blocks.append(Block(fence[1], "\n".join(inside), fence[2], not is_marked))
        elif line.startswith("    ") and not before:
            inside = [line[4:]]
            while (line := next(lines)).startswith("    "):
                inside.append(line[4:])
            blocks.append(Block("bash", "\n".join(inside), None, not is_marked))
        before, is_marked = line, line.startswith("<!-- not run: ") or (is_marked and not line)
    return blocks


def commands(block: Block) -> list[list[str]]:
    """The words of each command, without a prefix (`srun`, `NAME=value`)."""
    lines = block.text.replace("\\\n", " ").splitlines()
    split = [shlex.split(line, comments=True) for line in lines]
    return [_program(words) for words in split if words]


def _program(words: list[str]) -> list[str]:
    while words[0] == "srun" or re.match(r"[A-Z_]+=", words[0]):
        words = words[1:]
    return words


def module(words: list[str]) -> str:
    """The module of `python -m`, else the executable."""
    return words[2] if words[:2] == ["python", "-m"] else words[0]


def check(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails unless the command exists and takes the arguments."""
    program = module(words)
    if program == "make":
        for word in words[1:]:
            name, equals, value = word.partition("=")
            source = (REPOSITORY / "Makefile").read_text()
            assert re.search(rf"^{re.escape(name)} \?=" if equals else rf"^{re.escape(word)}:", source, re.MULTILINE), (
                word
            )
            if name == "ARGS":
                check(["python", "-m", "mimic.train", *shlex.split(value)], monkeypatch)
    elif words[:2] == ["pip", "download"]:
        assert "--no-deps" in words, words
    elif program == "pip":
        assert words[:4] == ["pip", "install", "-c", "constraints.txt"] and words[4] == "-e", words
        extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        assert set(re.findall(r"\w+", words[5])) <= set(extras), words
    elif program == "http.server":
        assert words[3] == "--directory", words
    elif program == ".":
        assert words == [".", ".venv/bin/activate"]
    elif program.startswith("mimic."):
        _compose(program.removeprefix("mimic."), words[3:], monkeypatch)
    elif program.startswith("benchmarks."):
        _parse(program, words[3:], monkeypatch)
    else:
        pytest.fail(f"tests/helpers/pages.py does not know how to check: {shlex.join(words)}")


def _compose(name: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Composes the command's config, or those of a sweep's runs, from its arguments, and does nothing with it."""
    composed: list[Any] = []
    prepare: Callable[[Any], cli.Work] = lambda config: composed.append(config) or (lambda: 0)  # noqa: E731
    assert hasattr(importlib.import_module(f"mimic.{name}"), "prepare")

    def setup(sweeper: Sweeper, *, hydra_context: Any, task_function: Any, config: Any) -> None:
        sweeper.hydra_context, sweeper.config = hydra_context, config  # and no launcher, which would look for Slurm

    def plan(sweeper: Sweeper, arguments: list[str]) -> None:
        composed.extend(sweeper.plan(arguments, pathlib.Path()))

    monkeypatch.setattr(sys, "argv", [f"mimic.{name}", *arguments])
    monkeypatch.setattr(Sweeper, "setup", setup)
    monkeypatch.setattr(Sweeper, "sweep", plan)
    cli.run(prepare, name)
    assert composed or "--cfg" in arguments


def _parse(name: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Parses the benchmark's arguments and stops."""

    class Parsed(Exception):
        pass

    parse_args = argparse.ArgumentParser.parse_args

    def stop(parser: argparse.ArgumentParser) -> None:
        parse_args(parser)
        raise Parsed

    with monkeypatch.context() as patch:
        patch.setattr(sys, "argv", [name, *arguments])
        patch.setattr(argparse.ArgumentParser, "parse_args", stop)
        with pytest.raises(Parsed):
            importlib.import_module(name).main()


def run_page(page: pathlib.Path, folder: pathlib.Path) -> None:
    """Runs a page's blocks in a folder, which is the current one."""
    scope: dict[str, Any] = {}
    for block in read_blocks(page.read_text()):
        if block.title:
            (folder / block.title).write_text(block.text)
        elif block.kind == "python" and block.is_run:
            exec(compile(block.text, str(page), "exec"), scope)  # noqa: S102 - our own text
        elif block.kind == "bash" and block.is_run:
            for words in commands(block):
                if not module(words).startswith(NOT_RUN):
                    _run(words, folder)


def _run(words: list[str], folder: pathlib.Path) -> None:
    program, arguments = words[2], [_newest_run(word, folder) for word in words[3:]]
    name = program.removeprefix("mimic.")
    if name == "train":
        name = "pose_mapper" if "trainer=pose_mapper" in arguments else "ppo"
    if any(word.startswith("resume=") for word in arguments):
        arguments += RESUMED
    else:
        flags = [word for word in arguments if word.startswith("-")]  # Hydra takes them before all others
        others = [word for word in arguments if word not in flags]
        arguments = [*flags, *SMALL.get(name, []), *others, *SHORT.get(name, [])]
    settings = {**CACHED, "PYTHONPATH": str(REPOSITORY)}
    ended = subprocess.run(
        [sys.executable, "-m", program, *arguments],
        cwd=folder,
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
        timeout=_LONGEST,
        check=False,
    )
    assert ended.returncode == 0, f"{shlex.join(words)}\n{ended.stdout[-2000:]}\n{ended.stderr[-2000:]}"


def _newest_run(word: str, folder: pathlib.Path) -> str:
    if word.endswith("runs/SWEEP"):
        return word.replace("runs/SWEEP", str(max(folder.glob("runs/sweep-*"), key=lambda path: path.stat().st_mtime)))
    key, placeholder, rest = word.partition("runs/NAME")
    if not placeholder:
        return word
    files = sorted(folder.glob(f"runs/*/{rest.lstrip('/') or 'config.yaml'}"), key=lambda path: path.stat().st_mtime)
    assert files, f"{word}: nothing on the page makes it"
    return f"{key}{files[-1] if rest else files[-1].parent}"
