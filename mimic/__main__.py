"""`python -m mimic`: lists the commands, one line each."""

import ast
import re
import sys
from pathlib import Path

from mimic import __version__

_ENTRY_POINT = re.compile(r"`python -m (mimic\.\w+)[^`]*`: (.*)\.")  # the docstring of an entry point


def commands() -> dict[str, str]:
    """Modules of the commands with what each does, read from the docstrings without importing the modules."""
    summaries = {}
    for file in sorted(Path(__file__).parent.glob("*.py")):
        docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
        if match := _ENTRY_POINT.fullmatch(docstring):
            summaries[match[1]] = match[2]
    return summaries


def _overview() -> str:
    summaries = commands()
    width = max(map(len, summaries))
    lines = [f"  {module:{width}}  {summary}" for module, summary in summaries.items()]
    return "\n".join(["Commands; python -m COMMAND --help shows the keys of each:", "", *lines])


if __name__ == "__main__":
    print(f"mimic {__version__}" if "--version" in sys.argv[1:] else _overview())
