"""Demonstrations from motion capture, and the inspection of a captured motion."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from mimic.arms.arm import ArmConfig
from mimic.arms.embodiment import Embodiment, load_mjcf
from mimic.arms.kinematic_tree import ALL_ENDS
from mimic.base.overrides import setting, shell_words
from mimic.commands.config import CaptureConfig, RecordingConfig
from mimic.commands.demonstrations_plot import plot_demonstrations
from mimic.commands.printed import say, train_command
from mimic.envs.config import DemonstrationConfig, EnvConfig, RewardConfig
from mimic.metric.kinematics import link_state_table
from mimic.motions.mocap.arms import find_arms, find_facing, unnamed
from mimic.motions.mocap.ball_chain import ball_chain_xml, zero_frames
from mimic.motions.mocap.clips import Windows, relative_speeds, slow_down_for, slow_down_for_windows, turned, windows
from mimic.motions.mocap.conventions import segments
from mimic.motions.mocap.link_motion import BOTH, LinkMotion, arm_motion, rigid_error, sides
from mimic.motions.mocap.names import parts_of
from mimic.motions.mocap.points import SIDES, ArmPoints, PointMotion, bridge_gaps, gaps, jumps, segment_lengths
from mimic.motions.mocap.reading import read_motion

MOTION_CAPTURE = (".bvh", ".c3d", ".trc")  # CSV and npz files may be those of joint angles
_SLOWEST = 20.0  # factor on the times of a short clip
_RATIO = 0.75, 1.7  # of the lengths of upper arm and forearm of people
_DIFFERENT = 0.1  # of a length: arms that differ by more are named
_CHECK = "check the points (capture.shoulder= elbow= wrist=)"
_CHANGING = 0.02  # of a length: a segment that changes more is named
_NAMED = 5  # segments
_STILL = 1e-5  # of a chain: single precision rounds by 1e-7


@dataclasses.dataclass(frozen=True)
class Capture:
    """The motion of an arm, or of both, from a file.

    Attributes:
      body: all points, as they were read.
      parts: the motion of the links between gaps.
      starts: time of each part in the file [s].
      bridged: number of bridged gaps.
    """

    body: PointMotion
    parts: list[LinkMotion]
    starts: list[float]
    bridged: int


def read_arm(source: Path, side: str, config: CaptureConfig, fixed: float = 0.0) -> Capture:
    """Reads the motion of one arm of a body, or of both.

    Args:
      source: the file.
      side: "left", "right" or "both".
      config: how it is read.
      fixed: fraction of the robot's chain that no joint moves, for the length of the trunk.

    Raises:
      ValueError: what `read_motion` and `arm_motion` reject.
    """
    body = read_body(source, config, side)
    arms, facing = find_arms(body), find_facing(body)
    if not set(sides(side)) <= set(arms):
        found, valid = " and ".join(arms) or f"none: {unnamed(body)}", f"{', '.join(SIDES)} or {BOTH}"
        raise ValueError(f"arm: expected {valid}, got {side!r}; {str(source)!r} has {found}")
    # The other shoulder shows where the body faces.
    groups = [*(group for one in sides(side) for group in arms[one][1:]), *facing.values()]
    names = [name for group in groups for name in group]
    used = body.select(list(dict.fromkeys(names)))
    pieces, bridged = bridge_gaps(used)
    label = "both arms" if side == BOTH else f"the {side} arm"
    # Split where a point jumps: a first frame in another pose, or markers that were exchanged.
    pieces = [piece.cut(*span) for piece in pieces for span in _between_jumps(piece)]
    pieces = [piece for piece in pieces if len(piece.positions) > 1]
    if not pieces:
        raise ValueError(f"source: {str(source)!r} has no time at which all points of {label} are known")
    longest = max(pieces, key=lambda piece: len(piece.positions))
    settings: dict[str, Any] = {"arms": arms, "facing": facing, "cutoff": config.cutoff}
    settings["trunk"] = trunk_length(arm_motion(longest, side, **settings).chain_length, config, fixed)
    angles = np.radians([config.yaw, config.pitch, config.roll])
    parts = [turned(arm_motion(piece, side, **settings), *angles) for piece in pieces]
    starts = [piece.begin for piece in pieces]
    spans = np.concatenate([part.end - part.start for part in parts])
    lengths = np.median(np.linalg.norm(spans, axis=2), axis=0)  # of one body
    return Capture(body, [_with_lengths(part, lengths) for part in parts], starts, bridged)


def read_body(source: Path, config: CaptureConfig, side: str = "", key: str = "source") -> PointMotion:
    """Reads all points of a file; for the points that the config names and `key` see `read_motion`.

    Raises:
      ValueError: what `read_motion` rejects, or points that are named for both arms.
    """
    arm = named_arm(config, side)
    return read_motion(source, unit=config.unit, up=config.up, subject=config.subject, arm=arm, key=key)


def named_arm(config: CaptureConfig, side: str) -> ArmPoints | None:
    """The points of an arm that a config names; None where it names none."""
    texts = config.shoulder, config.elbow, config.wrist, config.hand
    if not any(texts):
        return None
    if side == BOTH:
        raise ValueError(
            f"capture.shoulder, elbow, wrist and hand: expected with arm=left or arm=right, got arm={side}"
        )
    return ArmPoints(side, *(tuple(name.strip() for name in text.split("+") if name.strip()) for text in texts))


def trunk_length(chain: float, config: CaptureConfig, fixed: float) -> float:
    """Length of the trunk [m] below an arm with a length [m], for a robot with a fixed fraction of its chain."""
    return chain * fixed / (1 - fixed) if config.trunk is None else config.trunk


def fixed_fraction(arm: Embodiment) -> float:
    """Fraction of an arm's chain that stands still, at its base: before joints, or on the axis of the first one.

    The mean over the chains of a tree.
    """
    poses = np.random.default_rng(0).uniform(-1, 1, (8, arm.num_joints))
    states = link_state_table(arm, poses, np.zeros_like(poses))
    moves = np.ptp(states.position, axis=0).max(axis=1) + np.ptp(np.asarray(states.direction), axis=0).max(axis=1)
    still = np.where(moves < _STILL, np.asarray(arm.link_lengths), 0)
    return float(np.mean([still[list(chain)].sum() for chain in arm.chains]) / arm.chain_length)


def prepare_capture(config: RecordingConfig, env: EnvConfig, out: Path, plot: Path) -> Callable[[], None]:
    """Reads and cuts a captured motion; the returned function writes the demonstrations, the arm and a plot.

    Raises:
      ValueError: what `read_arm` and `windows` reject.
    """
    source, capture_config = Path(config.source).expanduser(), config.capture
    model = out.with_suffix(".xml")
    if model.exists():
        raise ValueError(f"out: {str(model)!r} exists, where the model of the arm would be written")
    learner = env.build_arm("learner").embodiment
    capture = read_arm(source, config.arm or "right", capture_config, fixed_fraction(learner))
    parts = capture.parts
    zero = zero_frames(parts[int(np.argmax([len(part.start) for part in parts]))])
    slow_down = capture_config.slow_down or slow_down_for(parts, capture_config.speed, cutoff=capture_config.cutoff)
    stretched = _slow_down_for_windows(capture, env)
    if capture_config.slow_down is None and slow_down < stretched <= _SLOWEST:
        slow_down = stretched  # a short clip
    cut = windows(
        parts, zero, starts=capture.starts, dt=env.control_dt, horizon=env.horizon, slow_down=slow_down,
        overlap=capture_config.overlap, held_out=capture_config.held_out, cutoff=capture_config.cutoff,
    )  # fmt: skip
    xml = ball_chain_xml(parts[0], zero)

    def run() -> None:
        console = Console()
        model.write_text(xml)
        cut.demonstrations.save(out)
        length = env.horizon * env.control_dt / slow_down
        title = f"{source.name}, {parts[0].name}: {len(cut.start)} windows of {length:.2f} s"
        plot_demonstrations(cut.demonstrations, load_mjcf(model, tip=[ALL_ENDS]), plot, title=title)
        say(console, *body_lines(capture.body), *_capture_lines(capture, cut, env))
        say(console, f"plot: {plot}", f"results: {out}, {model}")
        expert = ArmConfig(model=str(model), tip=[ALL_ENDS] if config.arm == BOTH else None)
        demonstrations = DemonstrationConfig(path=str(out), count=cut.training, held_out=cut.held_out)
        command = train_command(training_env(env, expert, demonstrations))
        say(console, f"train on it: {command}")

    return run


def training_env(env: EnvConfig, expert: ArmConfig, demonstrations: DemonstrationConfig) -> EnvConfig:
    """The environment of a training on a person's motion; a robot must not touch itself.

    Args:
      env: environment with the learner.
      expert: the person's arm.
      demonstrations: its motion.
    """
    reward = RewardConfig({"self_collision": 2.0}) if env.kind == "inner_loop" else env.reward
    return dataclasses.replace(env, expert=expert, demonstrations=demonstrations, reward=reward)


def prepare_capture_inspection(source: Path, config: CaptureConfig) -> Callable[[], None]:
    """Reads a captured motion; the returned function prints what it has.

    Raises:
      ValueError: what `read_motion` rejects.
    """
    body = read_body(source, config, key="clip")

    def run() -> None:
        console = Console()
        say(console, *body_lines(body))
        both = [f"{BOTH} env=bimanual"] if len(find_arms(body)) == len(SIDES) else []
        for side in [*find_arms(body), *both]:
            out_file = f"{source.stem}_{side.split()[0]}.npz"
            words = [setting("source", str(source)), *(f"arm={side}".split()), setting("out", out_file)]
            command = f"python -m mimic.demonstrations {shell_words([*words, *_changed(config)])}"
            say(console, f"demonstrations: {command}")

    return run


def _changed(config: CaptureConfig) -> list[str]:
    """The keys of a capture that are not the default ones, as words of a command."""
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    default = CaptureConfig()
    return [setting(f"capture.{name}", value) for name, value in values.items() if value != getattr(default, name)]


def body_lines(body: PointMotion) -> list[str]:
    """What a captured motion has: size, conventions, arms, gaps, jumps and lengths that change."""
    lines = [f"{len(body.names)} points, {body.duration:.2f} s at {body.rate:.5g} Hz", *body.notes]
    lines += _arm_lines(body)
    missing = gaps(body)
    if missing:
        longest = max(length for _, length in missing) / body.rate
        lines.append(f"gaps: {len(missing)}, the longest of {longest:.2f} s")
    if len(jumps(body)):
        lines.append(f"jumps: {len(jumps(body))}, the first at {jumps(body)[0] / body.rate:.2f} s")
    changing = []
    for parent, child, length in segment_lengths(body):
        median = np.nanmedian(length)
        if median > 0 and np.nanmax(np.abs(length - median)) > _CHANGING * median:
            changing.append(f"{parent} - {child} ({np.nanmin(length):.3f} to {np.nanmax(length):.3f} m)")
    if changing:
        rest = f" and {len(changing) - _NAMED} more" if len(changing) > _NAMED else ""
        lines.append(f"lengths that change: {', '.join(changing[:_NAMED])}{rest}")
    return lines


def _arm_lines(body: PointMotion) -> list[str]:
    """The points of each arm, and what is unusual about them."""
    arms, lengths = find_arms(body), {}
    lines = [] if arms else [unnamed(body)]
    for side, arm in arms.items():
        lines.append(f"{side} arm: {' - '.join('+'.join(group) for group in arm[1:] if group)}")
        lengths[side] = segments(body, arm)
        if not _RATIO[0] <= lengths[side][0] / lengths[side][1] <= _RATIO[1]:
            upper, forearm = lengths[side]
            lines.append(f"{side} arm: an upper arm of {upper:.2f} m and a forearm of {forearm:.2f} m; {_CHECK}")
    if len(arms) == len(SIDES):
        left, right = (sum(lengths[side]) for side in SIDES)
        if abs(left - right) > _DIFFERENT * max(left, right):
            lines.append(f"arms of {left:.2f} m (left) and {right:.2f} m (right), shoulder to wrist; {_CHECK}")
    if not body.named and not any(part and part.side for arm in arms.values() for part in parts_of(arm.elbow)):
        lines += ["the names state no side: taken for the right arm"] if arms else []
    if arms and not find_facing(body):
        lines.append("the other shoulder is unknown: forward is the x-axis of the capture (capture.yaw= turns it)")
    return lines


def _capture_lines(capture: Capture, cut: Windows, env: EnvConfig) -> list[str]:
    part = max(capture.parts, key=lambda part: len(part.start))
    lengths = ", ".join(f"{name} {length:.3f} m" for name, length in zip(part.names, part.link_lengths, strict=True))
    fastest = max(relative_speeds(part).max() for part in capture.parts) / cut.slow_down
    short = ", so that two windows fit" if cut.slow_down == _slow_down_for_windows(capture, env) else ""
    lines = [
        f"links: {lengths}; as rigid links they differ from the points by {1000 * rigid_error(part):.1f} mm",
        f"time: {cut.slow_down:.2f} times as long as captured{short} (capture.slow_down= sets it); the fastest link "
        f"then turns at {fastest:.2f} rad/s",
        f"windows of {env.horizon} steps of {env.control_dt:g} s: {cut.training} for training, the last "
        f"{cut.held_out} in time held out",
    ]
    if capture.bridged or len(capture.parts) > 1:
        lines.insert(0, f"gaps bridged: {capture.bridged}; parts without longer gaps or jumps: {len(capture.parts)}")
    return lines


def _slow_down_for_windows(capture: Capture, env: EnvConfig) -> float:
    return slow_down_for_windows(capture.parts, env.horizon * env.control_dt)


def _between_jumps(piece: PointMotion) -> Iterator[tuple[int, int]]:
    return itertools.pairwise([0, *map(int, jumps(piece)), len(piece.positions)])


def _with_lengths(part: LinkMotion, lengths: np.ndarray) -> LinkMotion:
    """The part with links of these lengths."""
    span = part.end - part.start
    span *= (lengths / np.median(np.linalg.norm(span, axis=2), axis=0))[:, None]
    return dataclasses.replace(part, end=part.start + span)
