"""The captured person of a view: a clip that is played, or points that arrive at a local socket."""

import contextlib
import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np

from mimic.arms.arm import ArmConfig, build_arm
from mimic.base.config import check_unused
from mimic.commands.capture import fixed_fraction, named_arm, read_arm, trunk_length
from mimic.commands.config import CaptureConfig, ViewConfig
from mimic.envs.config import EnvConfig
from mimic.motions.mocap.arms import find_arms, find_facing
from mimic.motions.mocap.ball_chain import ball_chain_xml, zero_frames
from mimic.motions.mocap.clips import slow_down_for
from mimic.motions.mocap.conventions import UNITS
from mimic.motions.mocap.link_motion import LinkMotion
from mimic.motions.mocap.live_hand import LiveHand
from mimic.motions.mocap.live_points import LiveArm, Sample, live_body
from mimic.motions.mocap.point_socket import PointListener
from mimic.runs.signals import Signals, noted_signals
from mimic.viewer.captured import Clip, ClipPlayer, HandTracker, PointTracker, Said, make_clip
from mimic.viewer.live_session import LiveSession
from mimic.viewer.origins import is_local

SCHEME = "tcp://"
_SAMPLES = 25  # complete ones, from which the lengths of a live arm are measured
_INCOMPLETE = 50  # samples without all points of the arm, after which a line says so
_POLL = 0.005  # s
_OF_CLIPS = ("cutoff", "speed", "slow_down")  # keys of `capture` without a meaning for live points
_OF_WINDOWS = ("overlap", "held_out")  # and without one for any view


class CapturedExpert(NamedTuple):
    """A captured arm that a view shows as its expert.

    Attributes:
      env: environment with the model of the arm as its expert.
      controls: makes the controls that move it.
    """

    env: EnvConfig
    controls: Callable[[LiveSession], Any]


def read_clip(config: ViewConfig) -> tuple[Clip, LinkMotion, np.ndarray]:
    """The clip in the file `source`, the links of its longest part, and their zero frames.

    Raises:
      ValueError: what `read_arm` rejects, or keys that a view does not use.
    """
    capture = config.capture
    check_unused(capture, _OF_WINDOWS, "with this source of a view, which cuts no windows", "capture.")
    fixed = fixed_fraction(config.env.build_arm("learner").embodiment)
    read = read_arm(Path(config.source).expanduser(), config.arm or "right", capture, fixed)
    kept = [index for index, part in enumerate(read.parts) if len(part.start) > 2]
    if not kept:
        raise ValueError(f"source: expected a motion of at least 3 samples, {config.source!r} has none without gaps")
    parts, starts = [read.parts[index] for index in kept], [read.starts[index] for index in kept]
    longest = max(parts, key=lambda part: len(part.start))
    zero = zero_frames(longest)
    slow_down = capture.slow_down or slow_down_for(parts, capture.speed, cutoff=capture.cutoff)
    clip = make_clip(parts, starts, zero, slow_down=slow_down, cutoff=capture.cutoff)
    print(
        f"{Path(config.source).name}, {longest.name}: {clip.duration:.1f} s, {slow_down:.2f} times as long as captured "
        f"(capture.slow_down=1 for as captured); gaps bridged: {read.bridged}; parts: {len(parts)}"
    )
    return clip, longest, zero


@contextlib.contextmanager
def clip_expert(env: EnvConfig, clip: Clip, links: LinkMotion, zero: np.ndarray) -> Iterator[CapturedExpert]:
    """Context in which the expert of a clip has a model file."""
    from mimic.viewer.capture_controls import ClipControls

    with _with_model(env, links, zero) as with_expert:
        yield CapturedExpert(with_expert, lambda session: ClipControls(session, ClipPlayer(clip)))


def listen(config: ViewConfig) -> PointListener:
    """A listener at the address `source`.

    Raises:
      ValueError: no address, one that other machines can reach though `host` is not that one, or one that is in use.
    """
    check_unused(
        config.capture,
        (*_OF_CLIPS, *_OF_WINDOWS),
        "with this source of a view, whose points are neither filtered nor slowed down",
        "capture.",
    )
    expected = f"source: expected a file or {SCHEME}localhost:PORT, got {config.source!r:.100}"
    try:
        parts = urlsplit(config.source)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ValueError(f"{expected}: {error}") from None
    if not host or not port or parts.path or parts.query or parts.username:
        raise ValueError(expected)
    if not is_local(host) and host != config.host:
        raise ValueError(
            f"source: expected an address that only this machine can reach, as localhost, got {host!r}; to take points "
            f"from other machines, set host={host} too"
        )
    return PointListener(host, port)


@contextlib.contextmanager
def live_expert(env: EnvConfig, arm: LiveArm, links: LinkMotion, listener: PointListener) -> Iterator[CapturedExpert]:
    """Context in which the expert of live points has a model file."""
    from mimic.viewer.capture_controls import PointControls

    assert arm.zero is not None
    tracker = PointTracker(listener, arm)
    with _with_model(env, links, arm.zero) as with_expert:
        yield CapturedExpert(with_expert, lambda session: PointControls(session, tracker))
    print(f"view: {tracker.summary}", flush=True)


def hand_expert(env: EnvConfig, listener: PointListener) -> CapturedExpert:
    """The expert of an environment, whose hand the poses of a person's hand move.

    Raises:
      ValueError: an expert without a known hand.
    """
    from mimic.viewer.capture_controls import PointControls

    expert = build_arm(env.expert, env.limits).embodiment
    if not expert.hand_joint:
        raise ValueError(f"expert: expected an arm whose hand is known, which poses of a hand move, got {expert.name}")
    return CapturedExpert(env, lambda session: PointControls(session, HandTracker(listener)))


def wait_for_arm(listener: PointListener, config: ViewConfig) -> tuple[LiveArm, LinkMotion] | LiveHand | None:
    """The arm of the person whose points arrive, and its links in the first samples; None after a signal.

    A hand is returned as it is.

    Points that are no arm's print a line, and it waits for others.
    """
    side, signals, say = config.arm or "right", Signals(), Said()
    fixed = fixed_fraction(config.env.build_arm("learner").embodiment)
    print(f"view: waiting for points at {config.source}   (Ctrl-C ends it)", flush=True)
    arm, samples, incomplete = None, [], 0
    with noted_signals(signals, "view: ending; repeat to stop immediately"):
        while not signals.caught:
            if listener.last_error:
                say(f"dropped a line: {listener.last_error}")
            if (sample := listener.take()) is None:
                time.sleep(_POLL)
                continue
            if sample.hand is not None:
                return sample.hand
            try:
                arm = arm or _live_arm(sample, side, config.capture)
                if arm.has_all(sample):
                    samples.append(sample)
                    if len(samples) >= _SAMPLES:
                        return _measured(arm, samples, config.capture, fixed)
                    continue
            except ValueError as error:
                say(str(error))
                arm, samples = None, []
                continue
            incomplete += 1
            if incomplete == _INCOMPLETE:
                say(f"{incomplete} samples without all of {', '.join(arm.names)}")
    return None


def _live_arm(sample: Sample, side: str, capture: CaptureConfig) -> LiveArm:
    named = named_arm(capture, side)
    body = live_body(sample, capture.unit, up=capture.up, subject=capture.subject, arm=named)
    arms = find_arms(body)
    if side not in arms:
        raise ValueError(f"arm: expected {' or '.join(arms)}, which the points have, got {side!r}")
    yaw, pitch, roll = np.radians([capture.yaw, capture.pitch, capture.roll])
    unit, up = UNITS[capture.unit or "m"], capture.up or "z"
    return LiveArm(arms, side, unit, up, 0.0, (yaw, pitch, roll), facing=find_facing(body))


def _measured(arm: LiveArm, samples: list[Sample], capture: CaptureConfig, fixed: float) -> tuple[LiveArm, LinkMotion]:
    """The arm with the trunk and the zero pose that its first samples result in."""
    trunk = trunk_length(arm.motion(samples).chain_length, capture, fixed)
    arm = dataclasses.replace(arm, trunk=trunk)
    links = arm.motion(samples)
    return dataclasses.replace(arm, zero=zero_frames(links), lengths=links.link_lengths), links


@contextlib.contextmanager
def _with_model(env: EnvConfig, links: LinkMotion, zero: np.ndarray) -> Iterator[EnvConfig]:
    """Context in which the expert of the environment is the model of a captured arm."""
    with tempfile.TemporaryDirectory(prefix="mimic-view-") as folder:
        model = Path(folder) / f"{links.name}.xml"
        model.write_text(ball_chain_xml(links, zero))
        yield dataclasses.replace(env, expert=ArmConfig(model=str(model)))
