"""Imports motions as demonstrations: CSV tables, npz files in LocoMuJoCo's format, LeRobot datasets and rosbag2."""

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mimic.arms.embodiment import Embodiment
from mimic.base.files import read_text
from mimic.base.npz import read_arrays
from mimic.motions.demonstrations import MAX_VALUE, Demonstrations, check_effort
from mimic.motions.formats.episodes import Motion
from mimic.motions.formats.lerobot_reading import is_lerobot, read_lerobot
from mimic.motions.formats.rosbag2 import BAG_FILES, is_rosbag2, read_rosbag2

SOURCES = (".csv", ".npz", *BAG_FILES)
_TIME, _DEMONSTRATION = ("time", "t"), "demonstration"  # columns of a table
_ANGLE_PREFIXES, _VELOCITY_PREFIXES = ("", "q_", "q", "qpos_"), ("qdot_", "qdot", "qvel_", "dq_")
_SIZES = {0: (7, 6), 2: (1, 1), 3: (1, 1)}  # columns of qpos and qvel by MuJoCo's joint type: free, slide, revolute
_NUMBERS = "biuf"  # kinds of NumPy's types
_FORMS = {  # of the arrays of an npz file: kinds of their types, and their numbers of dimensions
    "qpos": (_NUMBERS, (2,)), "qvel": (_NUMBERS, (2,)), "joint_names": ("U", (0, 1)), "frequency": (_NUMBERS, (0,)),
    "dt": (_NUMBERS, (0,)), "jnt_type": (_NUMBERS, (1,)), "split_points": (_NUMBERS, (0, 1)),
}  # fmt: skip
_ROUNDING = 1e-6  # tolerance of the duration (relative) and of joint ranges (rad): float32 rounds pi by 9e-8


# Above 40 lines because of its docstring.
def import_demonstrations(
    path: str | os.PathLike[str],
    arm: Embodiment,
    *,
    dt: float = 0.1,
    horizon: int = 50,
    joints: Sequence[str] = (),
    topic: str = "",
) -> tuple[Demonstrations, bool]:
    """Reads motions, resamples them at control steps, and checks them against the arm's limits.

    A CSV table has a header with the columns `time` [s] and, for each joint, its angle [rad]: its name, `q_NAME`, or
    `q_1`, `q_2`, ... by number. Optional columns are the joint's velocity [rad/s], `qdot_NAME` or `qdot_1`, ..., and
    `demonstration`, the number of the motion. An npz file has `qpos`, `joint_names` and `frequency` [1/s] (or `dt`),
    and optionally `qvel`, `jnt_type` and `split_points`, the first samples of the motions, in LocoMuJoCo's format.

    A folder is a LeRobot dataset of version 3, where an episode is a motion and a joint's angle [rad] is named NAME.pos
    or NAME, its velocity [rad/s] NAME.vel; or a rosbag2, or a folder of them, where a bag is a motion of
    sensor_msgs/JointState messages. Both need the extra `datasets`.

    Between samples the angles are cubic in time, with the file's velocities, or with central differences if it has
    none. Every demonstration is cut to the horizon.

    Args:
      path: the file, whose suffix selects the format, or the folder.
      arm: the expert.
      dt: control step [s].
      horizon: steps of a demonstration.
      joints: names of the arm's joints in the file, base to tip; the arm's own names where empty.
      topic: topic of a rosbag2, or feature of a LeRobot dataset; only needed where several have the joints.

    Returns:
      The demonstrations, and whether their velocities were computed by differentiation.

    Raises:
      ValueError: a file that is missing or has another format, lacks joints, is shorter than the horizon, is not in
        rad, or exceeds the arm's velocity limits; a package that is not installed.
    """
    source = Path(path)
    names = tuple(joints) or arm.joint_names
    if len(names) != arm.num_joints:
        raise ValueError(f"joints: expected {arm.num_joints} names, of {', '.join(arm.joint_names)}, got {len(names)}")
    motions = _read(source, names, topic)
    for index, motion in enumerate(motions):
        _check(motion, f"demonstration {index} in {str(source)!r}", arm, dt * horizon)
    resampled = [_resampled(motion, dt, horizon) for motion in motions]
    qpos, qvel = (np.stack(column) for column in zip(*resampled, strict=True))
    imported = Demonstrations(qpos, qvel, qpos[:, -1], float(dt), arm.name, arm.joint_names)
    check_effort(imported, arm)
    return imported, any(motion.qvel is None for motion in motions)


def _read(source: Path, names: Sequence[str], topic: str) -> list[Motion]:
    """The motions of a file or a folder."""
    if is_lerobot(source):
        return read_lerobot(source, names, topic)
    if is_rosbag2(source):
        return read_rosbag2(source, names, topic)
    if topic:
        raise ValueError(f"topic: expected only for a LeRobot dataset or a rosbag2, got {topic!r} for {str(source)!r}")
    if source.is_dir():
        raise ValueError(f"source: expected a folder of a LeRobot dataset or of rosbag2, got {str(source)!r}")
    if not source.is_file():
        raise ValueError(f"source: no file at {str(source)!r}")
    if source.suffix not in SOURCES:
        raise ValueError(f"source: expected a file that ends in {', '.join(SOURCES)}, got {str(source)!r}")
    return (_read_csv if source.suffix == ".csv" else _read_npz)(source, names)


def _check(motion: Motion, name: str, arm: Embodiment, duration: float) -> None:
    for values in filter(lambda values: values is not None, motion):
        if not np.all(np.isfinite(values)):  # type: ignore[arg-type]
            raise ValueError(f"source: {name} has values that are not finite")
    if len(motion.time) < 2 or np.any(np.diff(motion.time) <= 0):
        raise ValueError(f"source: {name} needs two or more samples at times that increase")
    length = motion.time[-1] - motion.time[0]
    if length < duration * (1 - _ROUNDING):
        raise ValueError(
            f"source: {name} lasts {length:g} s, but an episode {duration:g} s; a smaller env.horizon makes it shorter"
        )
    lower, upper = np.asarray(arm.joint_range).T
    beyond = np.argwhere((motion.qpos < lower - _ROUNDING) | (motion.qpos > upper + _ROUNDING))
    if len(beyond):
        sample, joint = beyond[0]
        raise ValueError(
            f"source: {arm.joint_names[joint]} of {name} is at {motion.qpos[sample, joint]:.4g}, "
            f"expected rad in [{lower[joint]:.4f}, {upper[joint]:.4f}]"
        )


def _resampled(motion: Motion, dt: float, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles and velocities at control steps."""
    from scipy.interpolate import CubicHermiteSpline  # takes half a second, and only imports of motions need it

    time = motion.time - motion.time[0]
    qvel = np.gradient(motion.qpos, time, axis=0) if motion.qvel is None else motion.qvel
    spline = CubicHermiteSpline(time, motion.qpos, qvel)
    steps = np.minimum(dt * np.arange(horizon + 1), time[-1])  # rounding must not extrapolate
    return spline(steps), spline(steps, 1)


def _read_csv(path: Path, names: Sequence[str]) -> list[Motion]:
    try:
        header, *rows = [[cell.strip() for cell in row] for row in csv.reader(read_text(path).splitlines()) if row]
        table = np.array(rows, float).reshape(len(rows), len(header))
    except (ValueError, csv.Error) as error:
        raise ValueError(f"source: {str(path)!r} is no table of numbers below a header: {error}") from error
    times = [header.index(name) for name in _TIME if name in header]
    angles = _columns(header, names, _ANGLE_PREFIXES)
    lacking = [name for name, column in zip(names, angles, strict=True) if column is None]
    if not times or lacking:
        raise ValueError(
            f"source: {str(path)!r} lacks {', '.join([*([] if times else ['time']), *lacking])}; expected time and the "
            f"joints {', '.join(names)}, by name or as q_1, q_2, ..., got the columns {', '.join(header)}"
        )
    velocities = _columns(header, names, _VELOCITY_PREFIXES)
    velocity_columns = [column for column in velocities if column is not None]
    if velocity_columns and len(velocity_columns) < len(names):
        missing = [name for name, column in zip(names, velocities, strict=True) if column is None]
        raise ValueError(f"source: {str(path)!r} has velocities of some joints, but none of {', '.join(missing)}")
    numbers = table[:, header.index(_DEMONSTRATION)] if _DEMONSTRATION in header else np.zeros(len(table))
    parts = [table[numbers == number] for number in np.unique(numbers)]
    if not parts:
        raise ValueError(f"source: {str(path)!r} has no rows")
    angle_columns = np.array(angles, int)
    return [
        Motion(part[:, times[0]], part[:, angle_columns], part[:, velocity_columns] if velocity_columns else None)
        for part in parts
    ]


def _columns(header: Sequence[str], names: Sequence[str], prefixes: Sequence[str]) -> list[int | None]:
    """Column of each joint, by its name or its number from 1; None if there is none."""
    columns: list[int | None] = []
    for number, name in enumerate(names, start=1):
        spellings = [prefix + key for key in (name, str(number)) for prefix in prefixes if prefix or key == name]
        columns.append(next((header.index(spelling) for spelling in spellings if spelling in header), None))
    return columns


def _npz_content(path: Path) -> dict[str, Any]:
    keys = ("qpos", "qvel", "joint_names", "frequency", "dt", "jnt_type", "split_points")
    try:
        content: dict[str, Any] = dict(
            read_arrays(path, keys)
        )  # pickled arrays, as LocoMuJoCo's metadata, are not read
    except ValueError as error:
        raise ValueError(f"source: {str(path)!r} cannot be read as an npz file of motions: {error}") from error
    lacking = [key for key in ("qpos", "joint_names") if key not in content]
    if not {"frequency", "dt"} & set(content):
        lacking.append("frequency")
    if lacking:
        raise ValueError(
            f"source: {str(path)!r} lacks {', '.join(lacking)}; expected qpos, joint_names, frequency or dt, and "
            "optionally qvel, jnt_type, split_points"
        )
    for key, array in content.items():
        kinds, dimensions = _FORMS[key]
        if array.dtype.kind not in kinds or array.ndim not in dimensions:
            raise ValueError(
                f"source: {key} in {str(path)!r} has type {array.dtype} and shape {list(array.shape)}; "
                f"expected {'text' if kinds == 'U' else 'numbers'} of {dimensions[-1]} dimensions"
            )
        if key in ("qpos", "qvel") and not float(np.abs(array).max(initial=0)) <= MAX_VALUE:
            raise ValueError(f"source: {key} in {str(path)!r} has values that are not finite or above {MAX_VALUE:g}")
    return content


def _read_npz(path: Path, names: Sequence[str]) -> list[Motion]:
    content = _npz_content(path)
    qpos, qvel = content["qpos"], content.get("qvel")
    present = list(map(str, np.atleast_1d(content["joint_names"])))
    if missing := [name for name in names if name not in present]:
        raise ValueError(
            f"source: {str(path)!r} lacks the joints {', '.join(missing)}; it has {', '.join(present)}; "
            "joints=[...] names the arm's joints among these"
        )
    angle_at, velocity_at = _addresses(content.get("jnt_type"), present)
    for key, values, width in (("qpos", qpos, angle_at[-1]), ("qvel", qvel, velocity_at[-1])):
        if values is not None and values.shape != (len(qpos), width):
            expected = [len(qpos), int(width)]
            raise ValueError(
                f"source: {key} in {str(path)!r} must be {expected} for its joints, got {list(values.shape)}"
            )
    rate = content["dt"] if "dt" in content else content["frequency"]
    if not 1 / MAX_VALUE <= float(rate) <= MAX_VALUE:
        raise ValueError(
            f"source: frequency or dt in {str(path)!r} must be in [{1 / MAX_VALUE}, {MAX_VALUE}], got {rate}"
        )
    step = float(rate) if "dt" in content else 1 / float(rate)
    indices = [present.index(name) for name in names]
    qpos = np.asarray(qpos, float)[:, angle_at[indices]]
    qvel = None if qvel is None else np.asarray(qvel, float)[:, velocity_at[indices]]
    points = np.atleast_1d(content.get("split_points", (0, len(qpos))))
    bounds = [int(point) if np.isfinite(point) else -1 for point in points[: len(qpos) + 2]]
    if len(bounds) < 2 or bounds[0] != 0 or bounds[-1] != len(qpos) or np.any(np.diff(bounds) <= 0):
        raise ValueError(
            f"source: split_points in {str(path)!r} must increase from 0 to {len(qpos)}, the samples, got {bounds[:8]}"
        )
    return [
        Motion(step * np.arange(end - start), qpos[start:end], None if qvel is None else qvel[start:end])
        for start, end in zip(bounds[:-1], bounds[1:], strict=True)
    ]


def _addresses(types: np.ndarray | None, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """First column of each joint in qpos and in qvel; the last entry is the number of columns."""
    kinds = [3] * len(names) if types is None else [int(kind) for kind in types[: len(names) + 1]]
    if len(kinds) != len(names) or any(kind not in _SIZES for kind in kinds):
        raise ValueError(f"source: jnt_type: expected 0, 2 or 3 for each of {', '.join(names)}, got {kinds}")
    sizes = np.array([_SIZES[kind] for kind in kinds])
    angle_at, velocity_at = np.concatenate([[[0, 0]], np.cumsum(sizes, axis=0)]).T
    return angle_at, velocity_at
