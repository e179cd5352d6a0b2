"""Wall times of starting processes: `python -m benchmarks.startup [--out FILE]`; files are in the system's cache."""

import subprocess
import sys
from collections.abc import Iterator

import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, collect
from benchmarks.common.timing import time_call

COMMANDS = {
    "import jax": ("-c", "import jax"),
    "import mimic": ("-c", "import mimic"),
    "mimic.train --help": ("-m", "mimic.train", "--help"),
}
LOCKED = {"first imitate_pose, 7 to 4 joints": (3, 6, 7), "first imitate_pose, 7 to 7 joints": ()}
FIRST_POSE = """
import time, jax, mimic
expert, learner = mimic.panda(), mimic.panda(locked={})
correspondence, weights = mimic.arc_length_correspondence(expert, learner), mimic.DistanceWeights(translation=1.0)
started = time.perf_counter()
jax.block_until_ready(mimic.imitate_pose(expert, learner, expert.home, correspondence, weights).qpos)
print(time.perf_counter() - started)
"""
PROCESSES = 5  # in each of which a pose is the first


def rows() -> Iterator[Row]:
    for name, arguments in COMMANDS.items():
        command = [sys.executable, *arguments]
        timing = time_call(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL))  # noqa: B023
        yield {"what": name, "median_s": timing.median, "spread": timing.summary()["spread"]}
    for name, locked in LOCKED.items():
        command = [sys.executable, "-c", FIRST_POSE.format(locked)]
        outputs = [subprocess.run(command, check=True, capture_output=True).stdout for _ in range(PROCESSES)]
        seconds = np.array(outputs, float)
        yield {"what": name, "median_s": np.median(seconds), "spread": np.ptp(seconds) / np.median(seconds)}


def main() -> None:
    options = make_parser("startup", __doc__).parse_args()
    collect(options, rows(), "rows", "what median_s:.2f spread:.0%")


if __name__ == "__main__":
    main()
