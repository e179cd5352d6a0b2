"""`python -m mimic.view`: serves a live view or the playback of a policy until it is interrupted."""

import contextlib
import functools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import jax
from rich.console import Console

from mimic.base import compat
from mimic.base.config import new_path
from mimic.base.distribution import import_extra
from mimic.commands.arm_keys import check_no_arms
from mimic.commands.config import ViewConfig, base_numbers
from mimic.commands.view_capture import (
    SCHEME,
    CapturedExpert,
    clip_expert,
    hand_expert,
    listen,
    live_expert,
    read_clip,
    wait_for_arm,
)
from mimic.commands.view_server import check_port, serve
from mimic.envs.config import EnvConfig
from mimic.motions.demonstrations import load_demonstrations
from mimic.motions.formats.episodes import EXTRA
from mimic.motions.mocap.live_hand import LiveHand
from mimic.runs.checkpoints import load_checkpoint
from mimic.trainers.run_config import given_run, policy_run
from mimic.viewer.hand_following import HandSettings
from mimic.viewer.live_session import RATE, LiveSession

if TYPE_CHECKING:
    from mimic.viewer.controls import ExpertControls
    from mimic.viewer.page import Page
    from mimic.viewer.playback import Playback

CAPTURE_RATE = 100.0  # frames per second of a captured person, at most
_NUMBERS_RATE = 15.0  # per second, of the numbers, chart and maps, which cost a browser more than the arms


def prepare_view(config: ViewConfig, overrides: Sequence[str] = ()) -> Callable[[], int]:
    """Checks the config of a view and loads its arms, its pose mapper or its policy.

    Args:
      config: of the view.
      overrides: of the command line, of which those without effect are rejected.

    Raises:
      ValueError: viser is not installed, the port is in use, the arms or the run are invalid, or an override has no
        effect.
    """
    import_extra("viser", "view", "view")
    check_port(config.host, config.port)
    if config.record:
        new_path("record", config.record)
        import_extra("pyarrow", EXTRA, "record")
    from mimic.base.compilation import use_compilation_cache

    use_compilation_cache(config.compilation_cache)
    if config.run:
        check_no_arms(overrides, "with run=")
        return _prepare_playback(config)
    # Poses take less than it takes to wake a thread of XLA's up, which on busy cores has to wait for its turn.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    if config.mapper:
        check_no_arms(overrides, "with mapper=")
        return _prepare_mapper(config)
    config.env.check_one_learner()
    if config.source:
        check_no_arms(overrides, "with source=", ("expert",))
        return _prepare_captured(config)
    return _prepare_live(config, config.env, _session(config, config.env))


def _prepare_live(config: ViewConfig, env: EnvConfig, session: LiveSession) -> Callable[[], int]:
    """Prepares a view whose expert the user moves.

    Raises:
      ValueError: demonstrations that cannot be read or are another arm's.
    """
    demonstrations = None
    if config.demonstrations:
        demonstrations = load_demonstrations(Path(config.demonstrations).expanduser())
        demonstrations.check_fits(session.expert, demonstrations.dt, demonstrations.horizon)

    def expert() -> "ExpertControls":
        from mimic.viewer.manual_controls import ManualControls

        return ManualControls(session, env, demonstrations)

    return lambda: _serve_session(config, env, session, expert)


def _serve_session(
    config: ViewConfig,
    env: EnvConfig,
    session: LiveSession,
    expert: "Callable[[], ExpertControls]",
    rate: float = RATE,
    numbers_rate: float = math.inf,
) -> int:
    """Serves a session whose expert moves as its controls say; rates are of frames and of numbers [1/s]."""

    def show_session(page: "Page", times: Iterator[float]) -> None:
        from mimic.viewer.live_page import show_live

        show_live(page, times, session, env, expert(), numbers_rate)

    after = functools.partial(_finish, config, session)
    return serve(config, env, _title(config, env), show_session, after, rate)


def _session(config: ViewConfig, env: EnvConfig) -> LiveSession:
    """A session whose learner's hand follows as the config says."""
    x, y, z, yaw = base_numbers(config.base) or [0.0] * 4
    return LiveSession(env, hand=HandSettings(config.hand, base=(x, y, z, yaw)), is_recorded=bool(config.record))


def _finish(config: ViewConfig, session: LiveSession) -> None:
    """Ends a session, and writes what the hand drove; further data sets have numbers."""
    session.finish()
    first, number = Path(config.record).expanduser(), 0
    for recorder in session.driven:
        while os.path.lexists(folder := first.with_name(f"{first.name}-{number}") if number else first):
            number += 1
        recorder.write(folder)
        print(f"view: {recorder.episodes} episodes in {folder}", flush=True)
    if config.record and not session.driven:
        print("view: record: nothing was driven, as by hand=relative or the tab 'Hand'", flush=True)


def _prepare_mapper(config: ViewConfig) -> Callable[[], int]:
    """Prepares a view whose learner a pose mapper moves: one of a run directory, or one that comes with mimic.

    Raises:
      ValueError: see `given_run` and `PoseMapper.load`.
    """
    from mimic.trainers.pose_mapper.mapper import PoseMapper

    mapper = PoseMapper.load(given_run(config.mapper, "mapper", "pose_mapper")[0], config.checkpoint)
    return _prepare_live(config, mapper.env, LiveSession(mapper.env, mapper))


def _prepare_captured(config: ViewConfig) -> Callable[[], int]:
    """Checks the captured person of `source`; the returned function shows it."""

    def show(expert: CapturedExpert) -> int:
        live = _session(config, expert.env)
        return _serve_session(config, expert.env, live, lambda: expert.controls(live), CAPTURE_RATE, _NUMBERS_RATE)

    if config.source.startswith(SCHEME):
        listener = listen(config)

        def run_live() -> int:
            with contextlib.closing(listener):
                measured = wait_for_arm(listener, config)
                if measured is None:
                    return 0
                if isinstance(measured, LiveHand):
                    return show(hand_expert(config.env, listener))
                with live_expert(config.env, *measured, listener) as expert:
                    return show(expert)

        return run_live
    content = read_clip(config)

    def run_clip() -> int:
        with clip_expert(config.env, *content) as expert:
            return show(expert)

    return run_clip


def _prepare_playback(config: ViewConfig) -> Callable[[], int]:
    """Prepares the playback of a checkpoint."""
    compat.import_mjx()
    from mimic.trainers.make import make_ppo_trainer
    from mimic.viewer.playback import Playback

    run_dir, trained = policy_run(config.run, config.checkpoint)
    trained.env.check_one_learner()
    trainer = make_ppo_trainer(trained, run_dir)
    _, params = load_checkpoint(run_dir, trainer.params_template(), config.checkpoint)

    def run() -> int:
        with Console().status("running the policy on all demonstrations and computing the kinematic bound"):
            playback = Playback(trained.env, trainer.evaluator, trainer.evaluate(params))
            _ = trainer.evaluator.lower_bound
        play = functools.partial(_play, playback=playback, split=config.split)
        return serve(config, trained.env, _title(config, trained.env), play)

    return run


def _play(page: "Page", times: Iterator[float], playback: "Playback", split: str) -> None:
    from mimic.viewer.player import Player

    player = Player(page.server, playback, split)
    for dt in times:
        if player.advance(dt):
            episode = player.split, player.demonstration
            time = player.timeline.time
            frame, chart = playback.frame(*episode, time), playback.chart(*episode, time)
            page.show(frame, chart, playback.note(*episode))


def _title(config: ViewConfig, env: EnvConfig) -> str:
    if config.run:
        return f"{env.name}: the policy of {Path(config.run).name} moves the learner"
    return f"The {'pose mapper' if config.mapper else 'optimiser'} moves the learner"
