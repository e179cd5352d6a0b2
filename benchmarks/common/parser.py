"""The command line of every benchmark."""

import argparse
from collections.abc import Collection, Sequence
from pathlib import Path


class BenchmarkParser(argparse.ArgumentParser):
    """Options that all benchmarks share, `--out` and `--commit`; each benchmark adds its own.

    Args:
      name: of the benchmark.
      doc: docstring of its module; the first line is shown by `--help`.
      out: "FILE", "DIR" where results go into a folder, which is required, or "" for no results.
    """

    def __init__(self, name: str, doc: str | None, out: str = "FILE"):
        super().__init__(prog=f"python -m benchmarks.{name}", description=(doc or "").split("\n")[0])
        if out:
            text = "results file, figures beside it; default: print only" if out == "FILE" else "folder of results"
            self.add_argument("--out", type=Path, metavar=out, required=out == "DIR", help=text)
            self.add_argument("--commit", help="commit to record, if this is not a git checkout")

    def add_names(self, flag: str, choices: Collection[str], default: Sequence[str] | None = None) -> None:
        """An option that takes some of the choices; all of them by default."""
        default = list(choices if default is None else default)
        self.add_argument(flag, nargs="+", choices=choices, default=default, metavar="NAME", help="; ".join(choices))

    def add_numbers(self, flag: str, default: Sequence[float], text: str, kind: type = int) -> None:
        """An option that takes several numbers."""
        self.add_argument(flag, nargs="*", type=kind, default=list(default), metavar="N", help=text)
