"""The command `mimic`, also `python -m mimic`: `mimic train env=panda4dof` is `python -m mimic.train env=panda4dof`."""

import ast
import importlib
import re
import sys
from pathlib import Path

from mimic.base.config import BAD_INPUT, suggestion
from mimic.base.distribution import VERSION
from mimic.runs.signals import ended_without_reader

_ENTRY_POINT = re.compile(r"`python -m mimic\.(\w+)[^`]*`: (.*)\.")  # the docstring of an entry point
_HELP = ("-h", "--help")


def commands() -> dict[str, str]:
    """The commands with what each does, read from the docstrings without importing the modules."""
    summaries = {}
    for file in sorted(Path(__file__).parent.glob("*.py")):
        docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
        if match := _ENTRY_POINT.fullmatch(docstring):
            summaries[match[1]] = match[2]
    return summaries


@ended_without_reader()
def main(arguments: list[str] | None = None) -> int:
    """Runs the command that the first argument names; returns the exit code.

    Args:
      arguments: of the command line. Default None: those of this process.
    """
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in _HELP or name == "--version":
        print(_overview() if name in _HELP else f"mimic {VERSION}")
        return 0
    if name not in commands():
        print(f"error: {_unknown(name)}", file=sys.stderr)
        return BAD_INPUT
    from mimic.commands import cli

    sys.argv = [f"mimic.{name}", *rest]
    cli.run(importlib.import_module(f"mimic.{name}").prepare, name)
    return 0


def _unknown(name: str) -> str:
    if "=" in name:
        return f"expected a command before {name!r:.80}, as in mimic train env=panda4dof"
    valid = commands()
    return f"unknown command {name!r:.80}; valid are {', '.join(valid)}{suggestion(name, valid)}"


def _overview() -> str:
    summaries = commands()
    width = max(map(len, summaries))
    rows = [f"  {name:{width}}  {summary}" for name, summary in summaries.items()]
    head = "usage: mimic COMMAND [KEY=VALUE ...], or python -m mimic.COMMAND [KEY=VALUE ...]"
    return "\n".join([head, "", *rows, "", "mimic COMMAND --help shows the keys of each, mimic --version the version."])


if __name__ == "__main__":
    sys.exit(main())
