"""Start-up times: `python -m benchmarks.startup [--out FILE]`.

Each is a process of its own, with its files in the system's cache: importing jax, importing mimic, and the help of the
training command. The import of mimic counts beyond that of jax.
"""

import subprocess
import sys

from benchmarks.common.parser import BenchmarkParser
from benchmarks.common.record import Results, print_table
from benchmarks.common.timing import time_call

COMMANDS = {
    "import jax": ("-c", "import jax"),
    "import mimic": ("-c", "import mimic"),
    "mimic.train --help": ("-m", "mimic.train", "--help"),
}


def run(what: str) -> dict[str, float | str]:
    """Median and spread of the wall time of a process."""
    command = [sys.executable, *COMMANDS[what]]
    timing = time_call(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL))
    return {"what": what, "median_s": timing.median, "spread": timing.summary()["spread"]}


def main() -> None:
    results = Results("startup", BenchmarkParser("startup", __doc__).parse_args())
    rows = [run(what) for what in COMMANDS]
    print_table(rows, {"process": "{what}", "seconds": "{median_s:.2f}", "spread": "{spread:.0%}"})
    results.write(rows=rows)


if __name__ == "__main__":
    main()
