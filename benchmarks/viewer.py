"""The live view under load: browsers that move all sliders; latency, memory and open files over time.

    python -m benchmarks.viewer [--clients 20] [--seconds 60] [--rate 10] [--out FILE]

The clients are connections that speak the protocol of viser's page, and draw nothing.
"""

import argparse
import asyncio
import contextlib
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import viser
import zstandard
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from benchmarks.common.parser import make_parser
from benchmarks.common.process_samples import sample, trends
from benchmarks.common.record import Row, print_table, write_results

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")
SAMPLED = ["memory_mib", "handles", "threads"]
_SAMPLES = 600
_START_S = 120  # until the view is compiled
_CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [2.0, 0.0, 1.0], "fov": 0.75,
    "near": 0.01, "far": 1000.0, "image_height": 850, "image_width": 1360, "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}  # fmt: skip  # the first message of a page: before it, viser does not know the client
_NOTE = re.compile(r'id="mimic-note"[^>]*>([^<]*)')


def decode(frame: bytes) -> Iterator[dict[str, Any]]:
    """The messages in a frame from the server: two sizes, then MessagePack compressed by zstd."""
    size = int.from_bytes(frame[8:16], "little")
    content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size]))
    for message in content["messages"]:
        yield message if isinstance(message, dict) else message[-1]


def encoded_camera() -> bytes:
    """The first message of a page."""
    return msgspec.msgpack.encode(_CAMERA)


class Client:
    """A connection to a view.

    Attributes:
      sliders: by name, identifier and range of each.
      note: last note on the page; "compiling" at first.
      frames: number of frames received.
      delays: times from a moved slider to the next frame [s].
    """

    def __init__(self, connection: ClientConnection):
        self._connection = connection
        self.sliders: dict[str, tuple[str, float, float]] = {}
        self.note, self.frames = "compiling", 0
        self.delays: list[float] = []
        self._moved: float | None = None

    async def listen(self) -> None:
        """Reads what the server sends, for as long as the connection is open."""
        await self._connection.send(encoded_camera())
        async for frame in self._connection:
            assert isinstance(frame, bytes)
            updates = [message for message in decode(frame) if self._note_message(message)]
            if updates:
                self.frames += 1
                if self._moved is not None:
                    self.delays.append(time.monotonic() - self._moved)
                    self._moved = None

    def _note_message(self, message: dict[str, Any]) -> bool:
        """Notes a message; returns whether it is part of a new picture of the arms."""
        if message["type"] == "GuiSliderMessage":
            props = message["props"]
            self.sliders[props["label"]] = message["uuid"], props["min"], props["max"]
        elif message["type"] == "GuiUpdateMessage" and (match := _NOTE.search(str(message["updates"].get("content")))):
            self.note = match[1]
            return True
        return False

    async def move(self, name: str, value: float) -> None:
        """Moves a slider."""
        update = {"type": "GuiUpdateMessage", "uuid": self.sliders[name][0], "updates": {"value": value}}
        await self._connection.send(msgspec.msgpack.encode(update))
        self._moved = self._moved or time.monotonic()


async def drive(client: Client, rate: float, until: float, seed: int) -> None:
    """Moves the joints' sliders at random, at a rate [1/s]."""
    random = np.random.default_rng(seed)
    joints = [name for name in client.sliders if name not in ("rotation", "translation")]
    while time.monotonic() < until:
        name = str(random.choice(joints))
        _, low, high = client.sliders[name]
        await client.move(name, round(float(random.uniform(low, high)), 2))
        await asyncio.sleep(random.exponential(1 / rate))


async def load(address: str, pid: int, options: argparse.Namespace) -> Row:
    """Samples of the view's process while clients move sliders."""
    async with contextlib.AsyncExitStack() as stack:
        clients, tasks = [], []
        for _ in range(options.clients):
            connection = connect(address, subprotocols=[PROTOCOL], max_size=None, compression=None)
            clients.append(Client(await stack.enter_async_context(connection)))
            tasks.append(asyncio.create_task(clients[-1].listen()))
        began = time.monotonic()
        while any("compiling" in client.note or not client.sliders for client in clients):
            if time.monotonic() - began > _START_S:
                sys.exit(f"error: the view is not ready after {_START_S} s")
            await asyncio.sleep(0.2)
        samples, began = [], time.monotonic()
        moving = [drive(client, options.rate, began + options.seconds, seed) for seed, client in enumerate(clients)]
        driving = asyncio.gather(*moving)
        while not driving.done():
            samples.append({"time_s": round(time.monotonic() - began, 2), **sample(pid)})
            await asyncio.sleep(max(0.5, options.seconds / _SAMPLES))
        await driving
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    delays = [delay for client in clients for delay in client.delays]
    return {
        "samples": samples,
        "frames_per_s": float(np.median([client.frames for client in clients])) / options.seconds,
        "fewest_frames": min(client.frames for client in clients),
        "delay_ms": {q: float(np.quantile(delays, q / 100) * 1e3) for q in (50, 95, 99)},
    }


def measure(options: argparse.Namespace) -> Row:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "mimic.view", f"env={options.env}", f"port={port}"]
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        assert process.stdout is not None
        try:
            if "view:" not in process.stdout.readline():
                sys.exit("error: the view did not start")
            result = asyncio.run(load(f"ws://127.0.0.1:{port}", process.pid, options))
            process.send_signal(signal.SIGINT)
            result["exit_code"] = process.wait(60)
        finally:
            process.kill()
        errors.seek(0)
        result["errors"] = [line for line in errors.read().splitlines() if "view: ending" not in line][:20]
    return {**result, "trends": trends(result["samples"], SAMPLED)}


def main() -> None:
    options = make_parser("viewer", __doc__, env="planar4dof", clients=20, seconds=60.0, rate=10.0).parse_args()
    result = measure(options)
    settings = {name: getattr(options, name) for name in ("env", "clients", "seconds", "rate")}
    write_results(options, **settings, **result)
    print_table(result["trends"], "what first:,.1f last:,.1f maximum:,.1f per_hour:,.2f low:,.2f high:,.2f flat")
    delays = ", ".join(f"{q} %: {delay:.0f} ms" for q, delay in result["delay_ms"].items())
    print(
        f"{result['frames_per_s']:.1f} frames/s at a client; from slider to frame {delays}; errors: {result['errors']}"
    )


if __name__ == "__main__":
    main()
