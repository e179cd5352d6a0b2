"""`python -m mimic.view`: serves a live view or the playback of a policy until it is interrupted."""

import contextlib
import dataclasses
import importlib.util
import io
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import jax
from rich.console import Console

from mimic import compat
from mimic.arms.arm import build_arm
from mimic.commands.config import ViewConfig
from mimic.commands.view_capture import (
    CapturedExpert,
    clip_expert,
    is_address,
    listen,
    live_expert,
    read_clip,
    wait_for_arm,
)
from mimic.distribution import install_command
from mimic.envs.config import EnvConfig
from mimic.runs.checkpoints import load_checkpoint
from mimic.runs.signals import Signals, noted_signals
from mimic.trainers.run_config import load_config, policy_config, policy_run
from mimic.viewer.history import RATE
from mimic.viewer.live_session import LiveSession
from mimic.viewer.origins import is_local

if TYPE_CHECKING:
    from mimic.viewer.newest_checkpoint import NewestCheckpoint
    from mimic.viewer.page import Page
    from mimic.viewer.playback import Playback
    from mimic.viewer.player import Player
    from mimic.viewer.recorder import Recorder

_MAX_STEP = 0.1  # s, maximum time step, so that arms do not jump after a pause of the process
CAPTURE_RATE = 100.0  # frames per second of a captured person, at most
_NUMBERS_RATE = 15.0  # per second, of the numbers, chart and maps, which cost a browser more than the arms


def prepare_view(config: ViewConfig) -> Callable[[], int]:
    """Checks the config of a view and loads its arms, its pose mapper or its policy.

    Raises:
      ValueError: viser is not installed, the port is in use, or the arms or the run are invalid.
    """
    if not is_installed():
        raise ValueError(
            "view: expected the package viser, which is not installed; install it with the extra 'view': "
            f"{install_command('view')}"
        )
    check_port(config.host, config.port)
    from mimic.compilation import use_compilation_cache

    use_compilation_cache(config.compilation_cache)
    if config.follow:
        return _prepare_training_view(config)
    if config.run:
        return _prepare_playback(config)
    mapper, env = None, config.resolve_env()
    if config.mapper:
        from mimic.trainers.pose_mapper.any_arm_mapper import load_mapper, one_learner

        mapper = load_mapper(Path(config.mapper).expanduser(), config.checkpoint)
        env = one_learner(load_config(Path(config.mapper).expanduser()).env)
    # Poses take less than it takes to wake a thread of XLA's up, which on busy cores has to wait for its turn.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if config.source:
        return _prepare_captured(config, env)
    live = LiveSession(env, mapper)

    def follow(page: "Page", times: Iterator[float]) -> None:
        from mimic.viewer.live_page import show_live
        from mimic.viewer.manual_controls import ManualControls

        show_live(page, times, live, env, ManualControls(live, env, page.expert), mapper is None)

    return lambda: serve(config, env, follow, None, live.finish)


def _prepare_captured(config: ViewConfig, env: EnvConfig) -> Callable[[], int]:
    """Checks the captured person of `source`; the returned function shows it."""

    def show(expert: CapturedExpert) -> int:
        live = LiveSession(expert.env)

        def follow(page: "Page", times: Iterator[float]) -> None:
            from mimic.viewer.live_page import show_live

            show_live(page, times, live, expert.env, expert.controls(live), True, _NUMBERS_RATE)

        return serve(config, expert.env, follow, None, live.finish, rate=CAPTURE_RATE)

    if is_address(config.source):
        listener = listen(config)

        def run_live() -> int:
            with contextlib.closing(listener):
                measured = wait_for_arm(listener, config, env)
                if measured is None:
                    return 0
                with live_expert(env, *measured, listener) as expert:
                    return show(expert)

        return run_live
    content = read_clip(config, env)

    def run_clip() -> int:
        with clip_expert(env, *content) as expert:
            return show(expert)

    return run_clip


def _prepare_playback(config: ViewConfig) -> Callable[[], int]:
    """Prepares the playback of a checkpoint."""
    compat.import_mjx()
    from mimic.trainers.make import make_ppo_trainer
    from mimic.viewer.playback import Playback

    run_dir, trained = policy_run(config.run, config.checkpoint)
    trainer = make_ppo_trainer(trained, run_dir)
    _, params = load_checkpoint(run_dir, trainer.params_template(), config.checkpoint)
    playback = Playback(trained.env, trainer.evaluator)

    def evaluate() -> None:
        with Console().status("running the policy on all demonstrations and computing the kinematic bound"):
            playback.replace(trainer.evaluate(params))
            _ = trainer.evaluator.lower_bound

    return lambda: serve(
        config, trained.env, lambda page, times: _play(page, times, playback, config.split), before=evaluate
    )


def _prepare_training_view(config: ViewConfig) -> Callable[[], int]:
    """Prepares the playback of the newest checkpoint of a run that another process trains."""
    jax.config.update("jax_platforms", "cpu")  # the training may take the whole memory of the GPU
    compat.import_mjx()
    from mimic.trainers.make import make_ppo_trainer
    from mimic.viewer.newest_checkpoint import NewestCheckpoint
    from mimic.viewer.playback import Playback

    run_dir, trained = policy_config(config.run)
    trainer = make_ppo_trainer(trained, run_dir)
    newest, playback = NewestCheckpoint(trainer, run_dir), Playback(trained.env, trainer.evaluator)

    def show(page: "Page", times: Iterator[float]) -> None:
        newest.start()
        if not newest.exists:
            print(f"view: {run_dir} has no checkpoint yet; waiting for the first one", flush=True)
        _play_newest(page, times, playback, newest, config.split)

    return lambda: serve(config, trained.env, show, after=newest.finish)


def is_installed() -> bool:
    """Whether viser is installed."""
    return importlib.util.find_spec("viser") is not None


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
    show: "Callable[[Page, Iterator[float]], None]",
    before: Callable[[], None] | None = None,
    after: Callable[[], None] | None = None,
    rate: float = RATE,
) -> int:
    """Serves a page until a signal, with a rate of frames [1/s].

    Calls `before` before the server starts and `after` when it has ended.
    """
    from mimic.viewer.meshes import ArmShape
    from mimic.viewer.page import Page
    from mimic.viewer.recorder import Recorder
    from mimic.viewer.server import make_server

    if before is not None:
        before()
    if not is_local(config.host):
        print(
            f"view: host={config.host}: everyone who can reach this machine can see and move the arms; there is no "
            f"password. Safer: ssh -L {config.port}:localhost:{config.port} {socket.gethostname()}",
            file=sys.stderr,
        )
    signals = Signals()
    with noted_signals(signals, "view: ending; repeat to stop immediately"):
        server, gatekeeper = make_server(config.host, config.port)
        try:
            free = build_arm(dataclasses.replace(env.learner, locked=()), env.limits)  # joints are locked in the view
            match = env.metric.match_links(build_arm(env.expert, env.limits).embodiment, free.embodiment)
            colours = match.expert_colours, match.learner_colours
            shapes = [
                ArmShape(arm, env.limits, links) for arm, links in zip((env.expert, env.learner), colours, strict=True)
            ]
            names = [build_arm(arm, env.limits).embodiment.name.partition("-")[0] for arm in (env.expert, env.learner)]
            is_flat = all(arm.model == "planar" for arm in (env.expert, env.learner))
            page = Page(server, shapes, names, _title(config, env), is_flat, match)
            print(f"view: {address(config.host, server.get_port())}   (Ctrl-C ends it)", flush=True)
            show(page, _recorded(Recorder(server), ticks(signals, rate)))
        finally:
            with contextlib.redirect_stdout(io.StringIO()):
                server.stop()
            if after is not None:
                after()
    counts = {"rejected requests": gatekeeper.rejected, "dropped messages": gatekeeper.dropped}
    noticed = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    print(f"\nview: ended{noticed and f' ({noticed})'}", flush=True)
    return 0


def address(host: str, port: int) -> str:
    """The address to open in a browser on this machine."""
    name = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://[{name}]:{port}" if ":" in name else f"http://{name}:{port}"


def _title(config: ViewConfig, env: EnvConfig) -> str:
    policy = f"{'newest policy' if config.follow else 'policy'} of {Path(config.run).name}"
    controller = policy if config.run else "pose mapper" if config.mapper else "optimiser"
    return f"{env.name or 'mimic'}: the learner is moved by the {controller}"


def _play(page: "Page", times: Iterator[float], playback: "Playback", split: str) -> None:
    from mimic.viewer.player import Player

    player = Player(page.server, playback, split)
    for dt in times:
        if player.advance(dt):
            _show_playback(page, playback, player)


def _show_playback(page: "Page", playback: "Playback", player: "Player", text: str = "") -> None:
    """Shows the current frame of a playback, below a text."""
    episode = player.split, player.demonstration
    frame, note = playback.frame(*episode, player.time), playback.note(*episode)
    page.show(frame, playback.chart(*episode, player.time), f"{text}\n{note}" if text else note)


def _play_newest(
    page: "Page", times: Iterator[float], playback: "Playback", newest: "NewestCheckpoint", split: str
) -> None:
    """Plays each new checkpoint from when it is evaluated; the time in the episode goes on."""
    from mimic.viewer.player import Player

    page.show_note("waiting for the first checkpoint" if not newest.exists else "evaluating the newest checkpoint …")
    player, text = None, ""
    for dt in times:
        try:
            evaluation = newest.advance()
        except ValueError as error:
            evaluation = None
            print(f"view: {error}; waiting for the next one", file=sys.stderr, flush=True)
        if evaluation is not None:
            playback.replace(evaluation.rollouts)
            text = evaluation.text
            print(f"view: {text}", flush=True)
            player = player or Player(page.server, playback, split)
            player.refresh()
        if player is not None and player.advance(dt):
            _show_playback(page, playback, player, text)


def _recorded(recorder: "Recorder", times: Iterator[float]) -> Iterator[float]:
    """The time steps, also of the recording."""
    for dt in times:
        recorder.advance(dt)
        yield dt


def ticks(signals: Signals, rate: float = RATE) -> Iterator[float]:
    """Yields the time since the last tick [s], at a rate [1/s] at most, until a signal."""
    last = time.perf_counter()
    while not signals.caught:
        time.sleep(max(0.0, last + 1 / rate - time.perf_counter()))
        now = time.perf_counter()
        yield min(now - last, _MAX_STEP)
        last = now
