"""The command line of every benchmark."""

import argparse
from pathlib import Path
from typing import Any


def make_parser(name: str, doc: str | None, out: str = "FILE", **options: Any) -> argparse.ArgumentParser:
    """A parser with `--out`, `--commit`, and the options of a benchmark.

    Args:
      name: of the benchmark.
      doc: docstring of its module, which `--help` shows.
      out: "FILE", "DIR" for a folder, which is required, or "" without results.
      options: defaults by name: False for a flag, a type for an option without default, a list for several numbers, any
        other collection for some of its names.
    """
    parser = argparse.ArgumentParser(f"python -m benchmarks.{name}", description=doc)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.set_defaults(benchmark=name)
    if out:
        parser.add_argument("--out", type=Path, metavar=out, required=out == "DIR", help="results; figures next to it")
        parser.add_argument("--commit", help="commit to record, if this is not a git checkout")
    for option, default in options.items():
        parser.add_argument(f"--{option.replace('_', '-')}", **_arguments(default), help="default: %(default)s")
    return parser


def _arguments(default: Any) -> dict[str, Any]:
    if default is False:
        return {"action": "store_true"}
    if isinstance(default, type):
        return {"type": default, "metavar": default.__name__}
    if isinstance(default, str | int | float):
        return {"type": type(default), "default": default, "metavar": type(default).__name__}
    if isinstance(default, list):
        return {"nargs": "*", "type": type(default[0]), "default": default, "metavar": "N"}
    return {"nargs": "+", "choices": list(default), "default": list(default), "metavar": "NAME"}
