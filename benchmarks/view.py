"""How often the live view can show something new: `python -m benchmarks.view [--env NAME]`; prints, writes nothing.

The update is all that happens between a new pose of the expert and what is sent: following, the kinematic bound, the
distances, the drawings. The page adds viser's work for all clients; what a browser needs to draw is its own.
"""

import argparse
import itertools
import socket
import threading
import time
from collections.abc import Callable

import numpy as np
import viser
from rich.console import Console
from websockets import Subprotocol
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from benchmarks.timing import time_call
from mimic.envs import env_config
from mimic.viewer.history import RATE, History
from mimic.viewer.live_session import LiveSession
from mimic.viewer.meshes import ArmShape
from mimic.viewer.page import Page

NEEDED = 20  # updates a second
SECONDS = 5.0
SUBPROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="panda4dof")
    env = env_config(parser.parse_args().env)
    live, console = LiveSession(env), Console()
    began = time.perf_counter()
    live.compile()
    console.print(f"compiled in {time.perf_counter() - began:.1f} s")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    shapes = [ArmShape(arm, env.limits) for arm in (env.expert, env.learner)]
    page = Page(server, shapes, ("expert", "learner"), "benchmark", is_flat=False)
    angles = itertools.cycle(np.sin(np.linspace(0, 2 * np.pi, 200)))
    history = History()

    def update() -> None:
        live.move(1, next(angles))
        frame = live.advance(1 / RATE)
        if frame is not None:
            history.add(frame)
            page.show(frame, history.chart(), "")

    for name, call in (("live state alone", lambda: live_alone(live, angles)), ("with the page", update)):
        timing = time_call(call, wait=lambda _: None)
        console.print(f"{name}: {1e3 * timing.median:.2f} ms, {1 / timing.median:.0f} a second ({NEEDED} needed)")
    shown, received = served(port, update)
    console.print(f"served for {SECONDS:g} s at {RATE:g} a second: {shown:.1f} shown, {received:.1f} received")
    server.stop()


def served(port: int, update: Callable[[], None]) -> tuple[float, float]:
    """Updates a second that the server makes, and that a client receives which draws nothing."""
    arrived: list[float] = []
    with connect(f"ws://127.0.0.1:{port}", subprotocols=[SUBPROTOCOL], max_size=None) as client:

        def listen() -> None:
            try:
                while message := client.recv():
                    arrived.append(time.perf_counter())
                    assert isinstance(message, bytes)
            except ConnectionClosed:
                pass

        threading.Thread(target=listen, daemon=True).start()
        time.sleep(2.0)  # the scene itself
        arrived.clear()
        count, began = 0, time.perf_counter()
        while time.perf_counter() < began + SECONDS:
            update()
            count += 1
            time.sleep(max(0.0, began + count / RATE - time.perf_counter()))
        seconds = time.perf_counter() - began
        time.sleep(0.5)
        return count / seconds, len(arrived) / seconds


def live_alone(live: LiveSession, angles: itertools.cycle) -> None:
    live.move(1, next(angles))
    live.advance(1 / RATE)


if __name__ == "__main__":
    main()
