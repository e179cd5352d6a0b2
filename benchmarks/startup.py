"""Wall times of starting processes: `python -m benchmarks.startup [--out FILE]`; files are in the system's cache."""

import subprocess
import sys

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect
from benchmarks.common.timing import time_call

FIRST_POSE = """
import mimic
expert, learner = mimic.panda(), mimic.panda(locked=(3, 6, 7))
correspondence = mimic.arc_length_correspondence(expert, learner)
mimic.imitate_pose(expert, learner, expert.home, correspondence, mimic.DistanceWeights(translation=1.0))
"""
COMMANDS = {
    "import jax": ("-c", "import jax"),
    "import mimic": ("-c", "import mimic"),
    "first imitate_pose": ("-c", FIRST_POSE),
    "mimic.train --help": ("-m", "mimic.train", "--help"),
}


def measure(name: str) -> Row:
    command = [sys.executable, *COMMANDS[name]]
    timing = time_call(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL))
    return {"what": name, "median_s": timing.median, "spread": timing.summary()["spread"]}


def main() -> None:
    options = make_parser("startup", __doc__).parse_args()
    collect(options, map(measure, COMMANDS), "rows", "what median_s:.2f spread:.0%")


if __name__ == "__main__":
    main()
