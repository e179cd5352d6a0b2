"""The server of a live view: the page with its arms, and the rate of its frames, until a signal."""

import contextlib
import dataclasses
import io
import socket
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from mimic.arms.arm import ArmConfig, build_arm
from mimic.commands.config import ViewConfig
from mimic.envs.config import EnvConfig
from mimic.runs.signals import Signals, noted_signals
from mimic.viewer.live_session import RATE
from mimic.viewer.origins import is_local

if TYPE_CHECKING:
    from mimic.viewer.page import Page

_MAX_STEP = 0.1  # s, maximum time step, so that arms do not jump after a pause of the process


def check_port(host: str, port: int) -> None:
    """Raises a `ValueError` unless a server can bind this address and port."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise ValueError(f"host: expected an address of this machine, as 127.0.0.1, got {host!r}: {error}") from None
    with socket.socket(family, kind, protocol) as probe:
        probe.setsockopt(
            socket.SOL_SOCKET, socket.SO_REUSEADDR, 1
        )  # a port of a server that has just ended counts as free
        try:
            probe.bind(address)
        except OSError as error:
            raise ValueError(
                f"port: expected a free port at {host}, got {port}: {error.strerror}; "
                f"choose another, as in port={port + 1}"
            ) from None


def serve(
    config: ViewConfig,
    env: EnvConfig,
    title: str,
    show: "Callable[[Page, Iterator[float]], None]",
    after: Callable[[], None] | None = None,
    rate: float = RATE,
) -> int:
    """Serves a page until a signal, with a rate of frames [1/s]; calls `after` when it has ended."""
    from mimic.viewer.meshes import ArmShape
    from mimic.viewer.page import Page
    from mimic.viewer.server import make_server

    if not is_local(config.host):
        print(
            f"view: host={config.host}: everyone who can reach this machine can see and move the arms; there is no "
            f"password. Safer: ssh -L {config.port}:localhost:{config.port} {socket.gethostname()}",
            file=sys.stderr,
        )
    signals = Signals()
    with noted_signals(signals, "view: ending; repeat to stop immediately"):
        server = make_server(config.host, config.port)
        try:
            free = build_arm(dataclasses.replace(env.learner, locked=()), env.limits)  # joints are locked in the view
            match = env.metric.match_links(build_arm(env.expert, env.limits).embodiment, free.embodiment)
            expert = _name(env.expert, env), ArmShape(env.expert, env.limits, match.expert_colours)
            learner = _name(env.learner, env), ArmShape(env.learner, env.limits, match.learner_colours)
            is_flat = env.expert.model == env.learner.model == "planar"
            page = Page(server, expert, learner, match, title, is_flat)
            print(f"view: {address(config.host, server.get_port())}   (Ctrl-C ends it)", flush=True)
            show(page, ticks(signals, rate))
        finally:
            with contextlib.redirect_stdout(io.StringIO()):
                server.stop()
            if after is not None:
                after()
    print("\nview: ended", flush=True)
    return 0


def _name(arm: ArmConfig, env: EnvConfig) -> str:
    return build_arm(arm, env.limits).embodiment.name.partition("-")[0]


def address(host: str, port: int) -> str:
    """The address to open in a browser on this machine."""
    name = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://[{name}]:{port}" if ":" in name else f"http://{name}:{port}"


def ticks(signals: Signals, rate: float = RATE) -> Iterator[float]:
    """Yields the time since the last tick [s], at a rate [1/s] at most, until a signal."""
    last = time.perf_counter()
    while not signals.caught:
        time.sleep(max(0.0, last + 1 / rate - time.perf_counter()))
        now = time.perf_counter()
        yield min(now - last, _MAX_STEP)
        last = now
