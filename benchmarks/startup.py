"""How long processes take before they do anything: `python -m benchmarks.startup [--out FILE]`.

Each is a process of its own, with its files in the system's cache: importing jax, importing mimic, and the help of the
training command. What counts for mimic is what its import takes beyond jax's.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.record import write_results
from benchmarks.timing import time_call

COMMANDS = {
    "import jax": ("-c", "import jax"),
    "import mimic": ("-c", "import mimic"),
    "mimic.train --help": ("-m", "mimic.train", "--help"),
}


def run(what: str) -> dict[str, float | str]:
    """Median and spread of a process of its own."""
    command = [sys.executable, *COMMANDS[what]]
    timing = time_call(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL))
    figures = timing.summary()
    return {"what": what, "median_s": 1e-3 * figures["median_ms"], "spread": figures["spread"]}


def main() -> None:
    """Measures, shows, writes."""
    summary = (__doc__ or "").split(":")[0]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.startup", description=summary)
    parser.add_argument("--out", type=Path, metavar="FILE", help="file of results")
    parser.add_argument("--commit", help="what the results are of, where this is no git checkout")
    options = parser.parse_args()
    rows = [run(what) for what in COMMANDS]
    table = Table("process", "seconds", "spread")
    for row in rows:
        table.add_row(str(row["what"]), f"{row['median_s']:.2f}", f"{row['spread']:.0%}")
    Console().print(table)
    if options.out:
        write_results(options.out, "startup", options.commit, rows=rows)


if __name__ == "__main__":
    main()
