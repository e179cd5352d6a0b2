"""Imports motions as demonstrations: tables, npz and HDF5 files, LeRobot datasets and rosbag2."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mimic.arms.embodiment import Embodiment
from mimic.motions.cleaning import Notes, beyond_range, cleaned
from mimic.motions.demonstrations import RECORDED_SPEED, Demonstrations, check_effort, is_demonstrations
from mimic.motions.formats.archives import read_archive
from mimic.motions.formats.episodes import Motion, Recording
from mimic.motions.formats.hdf5 import SUFFIXES, is_hdf5, read_hdf5
from mimic.motions.formats.lerobot_reading import is_lerobot, read_lerobot
from mimic.motions.formats.names import is_by_order
from mimic.motions.formats.rosbag2 import BAG_FILES, is_rosbag2, read_rosbag2
from mimic.motions.formats.tables import TABLES, is_folder_of_tables, read_folder_of_tables, read_table
from mimic.motions.resampling import angles_and_velocities
from mimic.motions.units import find_unit, in_rad

SOURCES = (*TABLES, ".npz", *SUFFIXES, *BAG_FILES)
_ROUNDING = 1e-6  # relative tolerance of a duration and of a velocity limit


# Above 40 lines because of its docstring.
def import_demonstrations(
    path: str | os.PathLike[str],
    arm: Embodiment,
    *,
    dt: float = 0.1,
    horizon: int = 50,
    joints: Sequence[str] = (),
    topic: str = "",
    units: str = "",
    rate: float | None = None,
    joint_range: Float[np.ndarray, "joints 2"] | None = None,
) -> tuple[Demonstrations, list[str]]:
    """Reads motions, resamples them at control steps, cuts them into windows, and checks the arm's limits.

    `read_recording` says what is read and repaired. A motion of some horizons gives as many windows; shorter ones, and
    windows in which a joint exceeds its velocity limit, are left out.

    Args:
      path: the file, whose suffix selects the format, or the folder.
      arm: the expert.
      dt: control step [s].
      horizon: steps of a demonstration.
      joints: see `read_recording`.
      topic: see `read_recording`.
      units: see `read_recording`.
      rate: see `read_recording`.
      joint_range: see `read_recording`.

    Returns:
      The demonstrations, and lines about what was assumed, changed or left out.

    Raises:
      ValueError: what `read_recording` rejects; all motions are shorter than the horizon; most windows exceed the arm's
        velocity limits.
    """
    recording = read_recording(
        path, arm, dt=dt, joints=joints, topic=topic, units=units, rate=rate, joint_range=joint_range
    )
    notes, windows = list(recording.notes), []
    short, lost, duration = [], 0.0, dt * horizon
    for name, motion in recording.motions.items():
        length = motion.time[-1] - motion.time[0]
        starts = _window_starts(length, duration)
        windows += _windows(motion, starts, dt, horizon)
        if len(starts) == 0:
            short.append(f"{name} lasts {length:g} s")
        elif length - starts[-1] - duration > dt:
            lost += length - starts[-1] - duration
    if not windows:
        raise ValueError(
            f"source: {short[0]}, but an episode {duration:g} s; a smaller env.horizon makes it shorter"
            + (f"; so do {len(short) - 1} others" if len(short) > 1 else "")
        )
    if short:
        notes.append(
            f"shorter than {duration:g} s, and left out: {short[0]}" + f", and {len(short) - 1} more" * (len(short) > 1)
        )
    whole = len(recording.motions) - len(short)
    if len(windows) > whole or lost:
        left = f"; {lost:.3g} s at their ends are left out" if lost else ""
        notes.append(f"windows of {duration:g} s: {len(windows)}, of {_count(whole)}{left}")
    demonstrations = _demonstrations(windows, arm, dt, recording.gripper)
    if recording.gripper and demonstrations.gripper is None:
        notes.append(f"gripper left out, since some motions have no values of {', '.join(recording.gripper)}")
    return _within_velocity_limits(demonstrations, arm, notes), notes


# Above 40 lines because of its docstring.
def read_recording(
    path: str | os.PathLike[str],
    arm: Embodiment,
    *,
    dt: float = 0.1,
    joints: Sequence[str] = (),
    topic: str = "",
    units: str = "",
    rate: float | None = None,
    joint_range: Float[np.ndarray, "joints 2"] | None = None,
) -> Recording:
    """Reads the motions of an arm in full, at the times of the source, in rad, repaired and checked.

    Repeated times are dropped, full turns undone, motions split where a joint jumps or time steps back, and velocities
    dropped where they are not those of the angles: see `cleaned`. Motions with angles beyond the arm's range are left
    out, unless these are most.

    Args:
      path: a table (.csv, .tsv, .txt), an .npz file in LocoMuJoCo's format, a LeRobot dataset, a rosbag2, an HDF5
        file, a folder of these, or a folder of tables, one for each quantity.
      arm: whose joints are read.
      dt: scale at which velocities are compared [s].
      joints: names of the arm's joints in the source, base to tip; the arm's own names where empty.
      topic: topic of a rosbag2, feature of a LeRobot dataset, or data set of an HDF5 file; only needed where several
        have the joints.
      units: "rad", "deg" or "percent" of each joint's range; where empty, what the source states, or what is found.
      rate: samples per second, of tables and HDF5 files that do not state it.
      joint_range: of the arm's model [rad], where the arm itself has wider ones, as with limits=none.

    Raises:
      ValueError: a source that is missing or has another format, lacks joints, or whose units are not known; motions
        beyond the range; a package that is not installed.
    """
    source, names = Path(path), source_names(arm, joints)
    recording = read_source(source, names, topic, rate)
    check_named(recording, joints)
    model_range = np.asarray(arm.joint_range if joint_range is None else joint_range, float)
    unit, line = find_unit(str(source), recording, arm.joint_names, model_range, units)
    recording = in_rad(recording, unit, model_range)
    notes, motions, errors = Notes(), {}, []
    for name, motion in recording.motions.items():
        label = f"{name} in {str(source)!r}"
        try:
            motions |= cleaned(label, motion, arm.joint_names, np.asarray(arm.joint_range, float), notes)
        except ValueError as error:
            errors.append(error)
    if len(errors) > len(motions):
        is_in_rad = unit == "rad" and not units and "expected rad in" in str(errors[0])
        raise ValueError(f"{errors[0]}{'; degrees need units=deg' * is_in_rad}")
    for error in errors:
        notes.add("left out", str(error).removeprefix("source: "))
    beyond = beyond_range(motions, arm.joint_names, model_range)
    lines = [_summary(motions), *recording.notes, *filter(None, [line, beyond]), *notes.lines()]
    return recording._replace(motions=motions, notes=tuple(lines))


def source_names(arm: Embodiment, joints: Sequence[str]) -> tuple[str, ...]:
    """The names by which an arm's joints are looked for in a source.

    Raises:
      ValueError: not as many as the arm has joints, or one of them twice.
    """
    count = len(set(joints))
    if joints and not count == len(joints) == arm.num_joints:
        expected = f"{arm.num_joints} different names, of {', '.join(arm.joint_names)}"
        raise ValueError(
            f"joints: expected {expected}, got {len(joints)}{f', {count} of them different' * (count < len(joints))}"
        )
    return tuple(joints) or arm.joint_names


def check_named(recording: Recording, joints: Sequence[str]) -> None:
    """Rejects joints that the user names and that are not in a source, though it counts as many.

    Raises:
      ValueError: there are some.
    """
    missing = [name for name in joints if name not in recording.joints]
    if missing and recording.joints and is_by_order(recording.joints, joints):
        raise ValueError(f"joints: expected names in the source, as {', '.join(recording.joints)}, got {missing[0]!r}")


def _summary(motions: Mapping[str, Motion]) -> str:
    """How many motions of which length and rate there are, and where their velocities are from."""
    seconds = sum(motion.time[-1] - motion.time[0] for motion in motions.values())
    interval = np.median(np.concatenate([np.diff(motion.time) for motion in motions.values()]))
    stated = sum(motion.qvel is not None for motion in motions.values())
    source = {len(motions): "from the source", 0: "computed from the angles"}.get(
        stated, f"from the source in {stated}"
    )
    return f"{_count(len(motions))}, {seconds:.4g} s, {1 / interval:.4g} samples a second; velocities: {source}"


def _count(motions: int) -> str:
    return f"{motions} motion" + "s" * (motions != 1)


def read_source(source: Path, names: Sequence[str], topic: str, rate: float | None) -> Recording:
    """The motions of a file or a folder, as it has them; see `read_recording`."""
    if rate is not None and not rate > 0:
        raise ValueError(f"rate: expected samples per second, above 0, got {rate:g}")
    read_timed = read_lerobot if is_lerobot(source) else read_rosbag2 if is_rosbag2(source) else None
    if rate and (read_timed or not (is_hdf5(source) or source.name.lower().endswith(TABLES))):
        raise ValueError(f"rate: expected only for tables and HDF5 files, got {rate:g} for {str(source)!r}")
    if read_timed:
        return read_timed(source, names, topic)
    if is_hdf5(source):
        return read_hdf5(source, names, topic, rate)
    if topic:
        raise ValueError(
            f"topic: expected only for a LeRobot dataset, a rosbag2 or HDF5 files, got {topic!r} for {str(source)!r}"
        )
    if is_folder_of_tables(source):
        return read_folder_of_tables(source, names)
    if source.is_dir():
        raise ValueError(
            "source: expected a folder of a LeRobot dataset, of rosbag2 or HDF5 files, or of one table each for times, "
            f"positions and velocities, got {str(source)!r}; join tables of one motion each to one, with a column "
            "demonstration"
        )
    if not source.is_file():
        raise ValueError(f"source: no file at {str(source)!r}")
    if not source.name.lower().endswith(SOURCES):
        is_clip = source.suffix.lower() in (".bvh", ".c3d", ".trc")
        advice = f"; python -m mimic.demonstrations source={source} arm=left out=FILE.npz reads it" if is_clip else ""
        raise ValueError(f"source: expected a file that ends in {', '.join(SOURCES)}, got {str(source)!r}{advice}")
    if is_demonstrations(source):
        raise ValueError(
            f"source: {str(source)!r} has demonstrations in mimic's own format, which need no import; "
            "env.demonstrations.path=FILE of mimic.train trains on them"
        )
    return read_table(source, names, rate) if source.name.lower().endswith(TABLES) else read_archive(source, names)


def _window_starts(length: float, duration: float) -> np.ndarray:
    """Starts of windows in a motion: as many as fit, and one more that overlaps where half of it or more would fit."""
    if length < duration * (1 - _ROUNDING):
        return np.zeros(0)
    count = max(int(length / duration + 0.5), 1)
    return np.linspace(0, min(length - duration, (count - 1) * duration), count)


def _windows(motion: Motion, starts: np.ndarray, dt: float, horizon: int) -> list[Motion]:
    """The motion at the control steps of windows that begin at these times."""
    time = motion.time[0] + starts[:, None] + dt * np.arange(horizon + 1)
    time = np.minimum(time, motion.time[-1]).ravel()  # rounding must not extrapolate
    qpos, qvel = angles_and_velocities(motion, time, dt)
    resampled = Motion(time, qpos, qvel, _resampled_gripper(motion, time))
    return [resampled.take(slice(row, row + horizon + 1)) for row in range(0, len(time), horizon + 1)]


def _resampled_gripper(motion: Motion, time: np.ndarray) -> np.ndarray | None:
    """The gripper at any times, linear between samples that are numbers; None where a channel has none."""
    if motion.gripper is None or not np.isfinite(motion.gripper).any(axis=0).all():
        return None
    channels = []
    for channel in motion.gripper.T:
        known = np.isfinite(channel)
        channels.append(np.interp(time, motion.time[known], channel[known]))
    return np.stack(channels, axis=1)


def _demonstrations(windows: list[Motion], arm: Embodiment, dt: float, gripper: tuple[str, ...]) -> Demonstrations:
    qpos, qvel = (np.stack([getattr(window, field) for window in windows]) for field in ("qpos", "qvel"))
    channels = [window.gripper for window in windows if window.gripper is not None]
    names = tuple(f"gripper_{name}" if name.isdigit() else name for name in gripper)
    opening = np.stack(channels) if len(channels) == len(windows) else None  # type: ignore[arg-type]
    return Demonstrations(
        qpos, qvel, qpos[:, -1], float(dt), arm.name, arm.joint_names,
        gripper=opening, gripper_names=names if opening is not None else (),
    )  # fmt: skip


def _within_velocity_limits(demonstrations: Demonstrations, arm: Embodiment, notes: list[str]) -> Demonstrations:
    """The demonstrations that `check_effort` takes; notes those above the limits of the arm's model.

    Raises:
      ValueError: most are too fast.
    """
    limit = np.asarray(arm.velocity_limit) * (1 + _ROUNDING)
    kept = np.flatnonzero(np.all(np.abs(demonstrations.qvel) <= RECORDED_SPEED * limit, axis=(1, 2)))
    if 2 * len(kept) < demonstrations.count:
        check_effort(demonstrations, arm, RECORDED_SPEED)
    if len(kept) < demonstrations.count:
        notes.append(f"left out as too fast: {demonstrations.count - len(kept)} windows")
    slower = demonstrations.select(kept.tolist())
    peak = np.abs(slower.qvel).max(axis=(0, 1))
    fast = [f"{arm.joint_names[i]} at {peak[i]:.3g} of {limit[i]:.3g}" for i in np.flatnonzero(peak > limit)]
    if fast:
        notes.append(f"above the velocity limits that the model states, but kept: {', '.join(fast)} rad/s")
    return slower
