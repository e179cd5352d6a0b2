"""`python -m mimic.demonstrations`: records an expert or imports motions, and compares them with the arm's limits."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from mimic.arms.arm import Arm, build_arm, errors_of
from mimic.arms.capsules import fit_capsules
from mimic.arms.embodiment import Embodiment
from mimic.base.config import check_unused, new_path
from mimic.commands.capture import MOTION_CAPTURE, prepare_capture
from mimic.commands.config import RecordingConfig
from mimic.commands.demonstrations_plot import plot_demonstrations
from mimic.commands.printed import say
from mimic.envs.config import EnvConfig
from mimic.envs.imitation import recorded_demonstrations
from mimic.motions.demonstrations import Demonstrations, check_effort
from mimic.motions.importing import import_demonstrations
from mimic.motions.mocap.arms import find_arms
from mimic.motions.mocap.reading import read_motion
from mimic.retargeting.self_collision import smallest_clearances, touching_line
from mimic.trainers.progress import is_animated

_OF_POINTS = (".csv", ".npz")  # kinds of files that may have points of a person, or joint angles
_OF_SOURCE = "joints", "topic", "units", "rate"  # keys of a source of motions
_NOT_RECORDED = "with source=FILE, whose motions are not recorded"


def prepare_recording(config: RecordingConfig) -> Callable[[], None]:
    """Checks the config and records or imports the demonstrations; the returned function writes and plots them.

    Recording is part of the check: only the recording shows whether the arm's limits permit any goal.

    Raises:
      ValueError: a file exists or its folder does not, the arm is invalid, or its limits permit no goal.
    """
    out, plot = _files(config)
    env, console = config.resolve(), Console()
    if config.source and (config.arm or Path(config.source).suffix.lower() in MOTION_CAPTURE):
        check_unused(config, ("kind", "count", "seed", "limits", *_OF_SOURCE), _NOT_RECORDED)
        return prepare_capture(config, env, out, plot)
    with errors_of("expert"):
        arm = build_arm(env.expert, env.limits)
    if config.source:
        return _prepare_import(config, env, arm, out, plot)
    check_unused(config, (*_OF_SOURCE, "arm", "capture"), "without source=FILE")
    demonstrations, redrawn = _record(arm, env, console)
    check_effort(demonstrations, arm.embodiment)  # of the exact arrays to be written

    def run() -> None:
        demonstrations.save(out)
        recording = env.demonstrations
        title = f"{arm.embodiment.name}, {recording.kind} demonstrations: {recording.count}, seed {recording.seed}"
        plot_demonstrations(demonstrations, arm.embodiment, plot, title=title)
        console.print(_table(demonstrations, arm.embodiment))
        say(console, _limits_line(arm.embodiment), *_clearance_lines(env, arm, demonstrations))
        say(console, f"goals redrawn because a limit was exceeded: {redrawn}", f"plot: {plot}", f"results: {out}")

    return run


def _prepare_import(config: RecordingConfig, env: EnvConfig, arm: Arm, out: Path, plot: Path) -> Callable[[], None]:
    """Imports motions; the returned function writes and plots them."""
    check_unused(config, ("kind", "count", "seed"), _NOT_RECORDED)
    check_unused(config, ("capture",), "with a source of joint angles")
    source = Path(config.source).expanduser()
    model = arm if env.limits == "hardware" else build_arm(dataclasses.replace(env.expert, home=None), "hardware")
    try:
        imported, notes = import_demonstrations(
            source,
            arm.embodiment,
            dt=env.control_dt,
            horizon=env.horizon,
            joints=config.joints,
            topic=config.topic,
            units=config.units,
            rate=config.rate,
            joint_range=model.embodiment.joint_range,
        )
    except ValueError as error:
        if source.suffix.lower() in _OF_POINTS and _has_person(source):
            raise ValueError(
                f"source: {str(source)!r} has points of a person; expected arm=left, right or both"
            ) from error
        raise

    def run() -> None:
        console = Console()
        imported.save(out)
        plot_demonstrations(imported, arm.embodiment, plot, title=f"{arm.embodiment.name}, {source.name}")
        console.print(_table(imported, arm.embodiment))
        length = f"{imported.horizon} steps of {imported.dt:g} s"
        say(console, f"{source.name}: {imported.count} demonstrations, {length}", *notes, _gripper_line(imported))
        say(console, *_clearance_lines(env, arm, imported), f"plot: {plot}", f"results: {out}")

    return run


def _has_person(source: Path) -> bool:
    """Whether a table or npz file has points with an arm of a person."""
    try:
        return bool(find_arms(read_motion(source)))
    except ValueError:
        return False


def _gripper_line(demonstrations: Demonstrations) -> str:
    """A line about the gripper, in the units of its source."""
    if demonstrations.gripper is None:
        return "gripper: none"
    channels = np.moveaxis(demonstrations.gripper, -1, 0)
    ranges = [
        f"{name} from {values.min():.4g} to {values.max():.4g}"
        for name, values in zip(demonstrations.gripper_names, channels, strict=True)
    ]
    return f"gripper, as in the source: {', '.join(ranges)}"


def _clearance_lines(env: EnvConfig, arm: Arm, demonstrations: Demonstrations) -> list[str]:
    """A line about which demonstrations have links that touch; none for an arm without shapes."""
    try:
        capsules = fit_capsules(env.expert, env.limits)
    except ValueError:  # no geoms
        return []
    floor_height = env.world.floor_height if env.world else 0.0
    clearances = smallest_clearances(arm.embodiment, capsules, demonstrations.qpos, floor_height)
    return [touching_line(clearances)]


def _files(config: RecordingConfig) -> tuple[Path, Path]:
    """The new files of the demonstrations and, beside it, of their plot."""
    out = new_path("out", config.out, "file")
    if out.suffix != ".npz":
        raise ValueError(f"out: expected a file that ends in .npz, got {str(out)!r}")
    return out, new_path("out", str(out.with_suffix(".png")), "file")


def _record(arm: Arm, env: EnvConfig, console: Console) -> tuple[Demonstrations, int]:
    """Demonstrations, and the number of goals that were redrawn. Shows a progress bar on a terminal."""
    config, redrawn = env.demonstrations, 0
    columns = BarColumn(), MofNCompleteColumn(), TextColumn("left"), TimeRemainingColumn()
    with Progress(TextColumn("[bold]recording"), *columns, console=console, disable=not is_animated(console)) as bar:
        task = bar.add_task("record", total=config.count)

        def on_recorded(redrawn_goals: int) -> None:
            nonlocal redrawn
            redrawn += redrawn_goals
            bar.advance(task)

        demonstrations = recorded_demonstrations(env, arm, config.count, on_recorded=on_recorded)
    return demonstrations, redrawn


def _table(demonstrations: Demonstrations, arm: Embodiment) -> Table:
    title = f"{arm.name}, demonstrations: {demonstrations.count} of {demonstrations.horizon * demonstrations.dt:g} s"
    table = Table(
        title=title, title_justify="left", caption="in brackets: fraction of the limit", caption_justify="left"
    )
    table.add_column("joint")
    for header in ("angles\n[rad]", "peak velocity\n[rad/s]", "peak torque\n[N m]", "RMS torque\n[N m]"):
        table.add_column(escape(header), justify="right")  # a unit in brackets is not a style
    torque = np.full((1, 1, arm.num_joints), np.nan) if demonstrations.torque is None else demonstrations.torque
    lowest, highest = demonstrations.qpos.min(axis=(0, 1)), demonstrations.qpos.max(axis=(0, 1))
    range_fraction = (highest - lowest) / np.ptp(arm.joint_range, axis=1)
    peak_velocity, peak_torque = (np.abs(values).max(axis=(0, 1)) for values in (demonstrations.qvel, torque))
    rms_torque = np.sqrt(np.mean(torque**2, axis=(0, 1)))
    for joint, name in enumerate(arm.joint_names):
        table.add_row(
            name,
            f"{lowest[joint]:.2f} to {highest[joint]:.2f} ({range_fraction[joint]:.0%})",
            _with_fraction(peak_velocity[joint], arm.velocity_limit[joint]),
            _with_fraction(peak_torque[joint], arm.torque_limit[joint]),
            _with_fraction(rms_torque[joint], arm.torque_limit[joint]),
        )
    return table


def _with_fraction(value: float, limit: float) -> str:
    """Text of a value and its fraction of a finite limit; a dash for NaN."""
    if np.isnan(value):
        return "-"
    return f"{value:.2f} ({value / limit:.0%})" if np.isfinite(limit) else f"{value:.2f}"


def _limits_line(arm: Embodiment) -> str:
    """The limits that `check_effort` has checked, as a sentence."""
    limits = {"torque limits": arm.torque_limit, "velocity limits": arm.velocity_limit}
    checked = [name for name, limit in limits.items() if np.isfinite(limit).any()]
    unknown = [name for name in limits if name not in checked]
    if not checked:
        return f"{arm.name} has no torque limits and no velocity limits"
    note = f", which has no {unknown[0]}" if unknown else ""
    return f"all stay within the {' and '.join(checked)} of {arm.name}{note}"
