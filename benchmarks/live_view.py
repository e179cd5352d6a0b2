"""A captured person who moves a robot live: the time of one pose on one core, and the rate of the view.

    python -m benchmarks.live_view [--clip FILE] [--samples 3000] [--seconds 30] [--rate 100] [--out FILE]

A pose is from the line of JSON to the robot's joint angles: reading the line, the angles of the person's arm, and
`imitate_pose` from the last pose. The clip is that of the tests' generated person, unless `--clip` names one. For the
rate of the view, one process sends samples, the view runs in a second one, and a connection that draws nothing counts
what it receives.
"""

import argparse
import asyncio
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.common.parser import make_parser
from benchmarks.common.record import Row, print_table, write_results
from benchmarks.viewer import PROTOCOL, Client, decode

REPOSITORY = Path(__file__).parent.parent
_WARM_UP = 200  # poses
_START_S = 180  # until the view is compiled


def generated_clip(folder: Path) -> Path:
    """The file of the generated person."""
    from tests.helpers.bodies import bvh_text

    path = folder / "person.bvh"
    path.write_text(bvh_text())
    return path


def pose_latency(clip: Path, samples: int, slow_down: float) -> Row:
    """Times of the parts of one pose on one core [ms]."""
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[-1:])  # before JAX starts its threads
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)  # as the view does
    from mimic.arms.arm import ArmConfig, build_arm
    from mimic.commands.config import ViewConfig
    from mimic.commands.view_capture import _live_arm, _measured, _with_model, fixed_fraction
    from mimic.motions.mocap.live_points import Sample, parse_sample, sample_line
    from mimic.motions.mocap.reading import read_motion
    from mimic.viewer.follower import compile_functions, initial_settings

    config = ViewConfig(source="tcp://localhost:1", learner="panda")
    env, body = config.resolve_env(), read_motion(clip)
    learner = build_arm(ArmConfig(), env.limits, env.metric.links).embodiment
    lines = [sample_line(sample) for sample in _played(body, samples + _WARM_UP, slow_down, Sample)]
    first = [parse_sample(line) for line in lines[:25]]
    arm, links = _measured(_live_arm(first[0], "right", config.capture), first, config.capture, fixed_fraction(learner))
    assert arm.zero is not None
    with _with_model(env, links, arm.zero) as captured:
        settings = initial_settings(captured)
        functions = next(iter(compile_functions(captured, settings)))
    pose = np.array(functions.learner.embodiment.home, np.float32)
    times, cpu, steps = [], [], []
    for line in lines:
        began, began_cpu = time.perf_counter(), time.process_time()
        sample = parse_sample(line)
        parsed = time.perf_counter()
        person = arm.pose(sample).astype(np.float32)
        posed = time.perf_counter()
        before, pose = pose, np.asarray(jax.block_until_ready(functions.follow(person, pose, settings.weights)))
        done = time.perf_counter()
        cpu.append(1e3 * (time.process_time() - began_cpu))
        times.append([1e3 * (b - a) for a, b in ((began, done), (began, parsed), (parsed, posed), (posed, done))])
        steps.append(float(np.abs(pose - before).max()))
    os.sched_setaffinity(0, cores)
    names = ("pose", "reading", "person", "robot")
    columns = np.array(times[_WARM_UP:]).T
    row = {f"{name}_ms": _quantiles(column) for name, column in zip(names, columns, strict=True)}
    return {**row, "cpu_ms": _quantiles(cpu[_WARM_UP:]), "largest_step_rad": max(steps[_WARM_UP:]), "samples": samples}


def _played(body, count, slow_down, make):
    """Samples of a body at 100 Hz, slowed down; forwards and backwards in turn."""
    for number in range(count):
        played = number / 100 / slow_down % (2 * body.duration)
        index = round(min(played, 2 * body.duration - played) * body.rate)
        yield make(number / 100, dict(zip(body.names, body.positions[index], strict=True)))


def _quantiles(values: Sequence[float] | np.ndarray) -> dict[str, float]:
    return {f"p{q}": round(float(np.percentile(values, q)), 4) for q in (50, 90, 99)} | {
        "max": round(float(np.max(values)), 4)
    }


class Counter(Client):
    """A connection that notes when the learner has moved on the page.

    Attributes:
      moved: times [s].
    """

    def __init__(self, connection):
        super().__init__(connection)
        self.moved: list[float] = []

    async def listen(self) -> None:
        async for frame in self._connection:
            assert isinstance(frame, bytes)
            messages = list(decode(frame))
            for message in messages:
                self._note_message(message)
            if any(_moves_learner(message) for message in messages):
                self.moved.append(time.perf_counter())


def _moves_learner(message: dict) -> bool:
    return message["type"] == "SetOrientationMessage" and str(message.get("name", "")).startswith("/learner0/body")


async def watch(address: str, seconds: float) -> list[float]:
    """Times at which the learner moved on the page, once everything is compiled."""
    from websockets.asyncio.client import connect

    from benchmarks.viewer import encoded_camera

    async with connect(address, subprotocols=[PROTOCOL], max_size=None, compression=None) as connection:
        counter = Counter(connection)
        await connection.send(encoded_camera())
        task, began = asyncio.create_task(counter.listen()), time.monotonic()
        while "compiling" in counter.note:
            if time.monotonic() - began > _START_S:
                sys.exit(f"error: the view is not ready after {_START_S} s")
            await asyncio.sleep(0.2)
        await asyncio.sleep(2.0)
        start = time.perf_counter()
        await asyncio.sleep(seconds)
        task.cancel()
        return [moved for moved in counter.moved if moved >= start]


def view_rate(clip: Path, options: argparse.Namespace) -> Row:
    """Rate of the view while a sender moves the robot."""
    ports = [_free_port() for _ in range(2)]
    view = [
        sys.executable,
        "-m",
        "mimic.view",
        f"source=tcp://localhost:{ports[0]}",
        "learner=panda",
        f"port={ports[1]}",
    ]
    send = [sys.executable, str(REPOSITORY / "examples" / "send_points.py"), str(clip), "--port", str(ports[0])]
    send += ["--rate", str(options.rate), "--speed", str(1 / options.slow_down)]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(view, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment)
        sender = None
        try:
            assert process.stdout is not None
            if "waiting" not in process.stdout.readline():
                sys.exit("error: the view did not start")
            sender = subprocess.Popen(send, stdout=subprocess.DEVNULL, env=environment)
            address = re.search(r"http://(\S+)", process.stdout.readline())
            assert address is not None
            moved = asyncio.run(watch(f"ws://{address[1]}", options.seconds))
            sender.kill()
            process.send_signal(signal.SIGINT)
            rest, exit_code = process.stdout.read(), process.wait(60)
        finally:
            for started in filter(None, (sender, process)):
                started.kill()
                started.wait()
        errors.seek(0)
        said = errors.read().splitlines()
    intervals = 1e3 * np.diff(moved)
    per_second = np.histogram(moved, np.arange(moved[0], moved[-1], 1.0))[0]
    return {
        "frames_per_s": len(moved) / options.seconds, "fewest_in_a_second": int(per_second.min()),
        "interval_ms": _quantiles(intervals), "seconds": options.seconds, "sent_per_s": options.rate,
        "summary": next((line for line in rest.splitlines() if "samples" in line), ""), "exit_code": exit_code,
        "errors": [line for line in said if "ending" not in line][:20],
    }  # fmt: skip


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def main() -> None:
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    parser = make_parser("live_view", __doc__, clip="", samples=3000, seconds=30.0, rate=100.0, slow_down=3.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(options.clip) if options.clip else generated_clip(Path(folder))
        load = {"before": os.getloadavg()[0]}
        latency = pose_latency(clip, options.samples, options.slow_down)
        load["after_latency"] = os.getloadavg()[0]
        rate = view_rate(clip, options) if options.seconds else None
        load["after_view"] = os.getloadavg()[0]
    settings = {"clip": Path(options.clip).name or "generated", "slow_down": options.slow_down, "load_average": load}
    write_results(options, **settings, latency=latency, view=rate)
    rows = [{"part": name.removesuffix("_ms"), **latency[name]} for name in latency if name.endswith("_ms")]
    print_table(rows, "part p50 p90 p99 max")
    if rate:
        print(f"{rate['frames_per_s']:.1f} frames/s, intervals {rate['interval_ms']} ms; {rate['summary']}")


if __name__ == "__main__":
    main()
