"""Sends the points of a motion capture clip to a live view, in place of a camera or a headset.

    python -m mimic.view source=tcp://localhost:9000 learner=panda     # in one terminal
    python examples/send_points.py clip.bvh --port 9000                # in another

A sample is a line of JSON with a time [s] and the position of each point [m], z up:

    {"time": 0.01, "points": {"LeftArm": [0.1, 0.2, 1.4], "RightArm": null}}
"""

import argparse
import socket
import time

import numpy as np

from mimic.motions.mocap.live_points import Sample, sample_line
from mimic.motions.mocap.reading import read_motion

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("clip", help="BVH, C3D, TRC, CSV or npz file")
parser.add_argument("--host", default="localhost")
parser.add_argument("--port", type=int, default=9000)
parser.add_argument("--rate", type=float, default=100.0, help="samples per second")
parser.add_argument("--speed", type=float, default=0.3, help="of the motion; 1 as captured. People outrun most robots")
parser.add_argument("--seconds", type=float, default=float("inf"), help="when to stop; by default at Ctrl-C")
options = parser.parse_args()

motion = read_motion(options.clip)
print(f"{options.clip}: {len(motion.names)} points, {motion.duration:.1f} s", flush=True)


def sample_at(elapsed):
    """The sample of the clip at a time since the start [s]; the clip is played forwards and backwards in turn."""
    played = elapsed * options.speed % (2 * motion.duration)
    position = min(played, 2 * motion.duration - played) * motion.rate
    before = min(int(position), len(motion.positions) - 2)
    fraction = position - before
    points = (1 - fraction) * motion.positions[before] + fraction * motion.positions[before + 1]
    return Sample(elapsed, dict(zip(motion.names, points, strict=True)))


try:
    with socket.create_connection((options.host, options.port)) as connection:
        start = time.perf_counter()
        for count in range(int(np.clip(options.seconds * options.rate, 1, 1e12))):
            time.sleep(max(0.0, start + count / options.rate - time.perf_counter()))
            connection.sendall(sample_line(sample_at(count / options.rate)))
except KeyboardInterrupt:
    pass
except ConnectionRefusedError:
    raise SystemExit(f"error: no view listens at {options.host}:{options.port}; start it first") from None
except OSError as error:
    raise SystemExit(f"error: the view has closed the connection: {error.strerror}") from None
