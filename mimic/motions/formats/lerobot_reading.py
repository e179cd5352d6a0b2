"""Reads joint motions from a LeRobot dataset, version 2 or 3."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mimic.base.distribution import import_extra
from mimic.base.files import check_file, read_json
from mimic.motions.formats.episodes import (
    ANGLE,
    EXPERT,
    EXTRA,
    MAX_NUMBERS,
    VELOCITY,
    Motion,
    Quantity,
    Recording,
)
from mimic.motions.formats.lerobot import DATA_FOLDER, EPISODES_FOLDER, FINAL, INFO
from mimic.motions.formats.names import UNITS, common_unit, hand_position, parse_column, quantity_of, select

_TIME_TOLERANCE = 1e-4  # s: LeRobot's own, between a timestamp and that of its frame
_FLOATS = ("float32", "float64")
_NO_JOINTS = ("timestamp", "next.")  # features of LeRobot's own: times, rewards
_MAX_COLUMNS = 1000  # of a feature without names


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (path / INFO).is_file()


class _Feature(NamedTuple):
    """A feature that is a vector of numbers: columns by joint, for angles and for velocities, and units of angles."""

    columns: dict[Quantity, dict[str, int]]
    units: dict[str, str]


def read_lerobot(path: Path, joints: Sequence[str], feature: str = "") -> Recording:
    """The motions of joints, one for each episode. Needs pyarrow.

    Joints are found by their names in info.json: NAME.pos or NAME for the angle, NAME.vel for the velocity. Where
    mimic wrote the dataset, the state after the last frame is included.

    Args:
      path: folder of the dataset.
      joints: names of the joints, base to tip.
      feature: feature that has them; empty for the only one that does, or for what was measured.

    Raises:
      ValueError: a folder that cannot be read, or that lacks the joints or has them in several features.
    """
    import_extra("pyarrow", EXTRA, f"source: {str(path)!r} is a LeRobot dataset, which")
    try:
        info = read_json(path / INFO)
        fps, features = _check_info(info), _features(info["features"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"source: {str(path / INFO)!r} cannot be read: {_line(error)}") from error
    angles = {name: list(form.columns[ANGLE]) for name, form in features.items() if form.columns[ANGLE]}
    selection = select(str(path), angles, joints, feature, "feature")
    chosen = features[selection.entry]
    beside = selection.gripper_entry or selection.entry
    place = hand_position(angles)
    of_hand = place[0] if place else selection.entry
    episode, frame, time, values, of_gripper, hands = _read_frames(path, (selection.entry, beside, of_hand))
    order = np.lexsort((frame, episode))
    present, starts = np.unique(episode[order], return_index=True)
    final = _final_values(path, selection.entry)
    unit = common_unit(str(path), {joint: chosen.units[joint] for joint in selection.joints})
    motions, notes = {}, list(selection.notes)
    for number, rows in zip(present, np.split(order, starts[1:]), strict=True):
        times, line = _times(frame[rows], time[rows], fps)
        notes += [line] if line and line not in notes else []
        samples, gripper = values[rows], of_gripper[rows]
        if int(number) in final:
            times, samples = np.append(times, times[-1] + 1 / fps), np.vstack([samples, final[int(number)]])
            gripper = samples if beside == selection.entry else np.vstack([gripper, gripper[-1:]])
        qpos, qvel = (_select(samples, chosen.columns[quantity], selection.joints) for quantity in (ANGLE, VELOCITY))
        assert qpos is not None  # `select` has checked it
        opening = _select(gripper, features[beside].columns[ANGLE], selection.gripper) if selection.gripper else None
        hand = _select(hands[rows], features[of_hand].columns[ANGLE], place[1]) if place else None
        hand = hand if hand is None or len(hand) == len(times) else np.vstack([hand, hand[-1:]])
        motions[f"episode {number}"] = Motion(times, qpos, qvel, opening, hand)
    notes += _lacking(path, info, len(motions), len(episode))
    robot = str(info.get("robot_type") or "")
    return Recording(motions, unit=unit, robot=robot, notes=tuple(notes), **selection.facts)


def _lacking(path: Path, info: Mapping[str, Any], episodes: int, frames: int) -> list[str]:
    """Warnings about episodes, frames and videos that the metadata state and the dataset has not."""
    lines = []
    for what, count in (("episodes", episodes), ("frames", frames)):
        stated = info.get(f"total_{what}", count)
        if stated != count:
            lines.append(f"warning: {INFO} states {stated} {what}, the data has {count}")
    lines += [
        f"warning: the videos of {name} are missing, and it is left out of what is written"
        for name in missing_videos(path, info["features"])
    ]
    return lines


def missing_videos(path: Path, features: Mapping[str, Any]) -> list[str]:
    """The features that are videos of which the dataset has no file."""
    files = [file.relative_to(path).as_posix() for file in (path / "videos").rglob("*.mp4")]
    names = [name for name, form in features.items() if form.get("dtype") == "video"]
    return [name for name in names if not any(name in file or name.split(".")[-1] in file for file in files)]


def _check_info(info: Mapping[str, Any]) -> float:
    """The frames per second of a dataset of version 2 or 3."""
    version, fps = info.get("codebase_version"), info.get("fps")
    if not str(version).startswith(("v2.", "v3.")):
        raise ValueError(
            f"expected codebase_version v2.0 to v3.0, got {version!r:.80}; LeRobot converts older datasets"
        )
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 1e-3 <= fps <= 1e6:
        raise ValueError(f"expected frames per second in [0.001, 1e6] as fps, got {fps!r:.80}")
    return float(fps)


def _features(features: Mapping[str, Any]) -> dict[str, _Feature]:
    """The features that are vectors of numbers."""
    entries: dict[str, _Feature] = {}
    for feature, form in features.items():
        size: list[Any] = list(form.get("shape") or ())
        names = feature_names(form)
        if form.get("dtype") not in _FLOATS or size != [len(names)] or str(feature).startswith(_NO_JOINTS):
            continue
        columns: dict[Quantity, dict[str, int]] = {ANGLE: {}, VELOCITY: {}}
        stated = [str(unit).lower() for unit in form.get("units") or ()]
        units: dict[str, str] = {}
        for index, name in enumerate(names):
            column = parse_column(name)
            joint = column.joint.removeprefix(EXPERT)
            quantity = quantity_of(str(feature)) if column.quantity == ANGLE else column.quantity
            columns.setdefault(quantity, {})[joint] = index
            if quantity == ANGLE:
                own = stated[index] if len(stated) == len(names) else ""
                units[joint] = column.unit or UNITS.get(own, own)
        entries[str(feature)] = _Feature(columns, units)
    return entries


def feature_names(form: Mapping[str, Any]) -> list[str]:
    """Names of the columns of a feature, as datasets have them: a list, in a mapping or a list of one, or none."""
    names: Any = form.get("names")
    shape: list[Any] = list(form.get("shape") or ())
    if isinstance(names, Mapping) and all(isinstance(index, int) for index in names.values()):
        names = sorted(names, key=names.get)  # type: ignore[arg-type]
    elif isinstance(names, Mapping | list | tuple) and len(names) == 1 and len(shape) == 1:
        (inner,) = names.values() if isinstance(names, Mapping) else names
        names = inner if isinstance(inner, list | tuple) else names
    if names is None and len(shape) == 1:
        return [str(number) for number in range(1, min(shape[0], _MAX_COLUMNS) + 1)]
    return [str(name) for name in names] if isinstance(names, list | tuple) else []


def _select(samples: np.ndarray, columns: Mapping[str, int], joints: Sequence[str]) -> np.ndarray | None:
    """The columns of joints; None where one has no such column."""
    if not set(joints) <= set(columns):
        return None
    chosen = [columns[joint] for joint in joints]
    if max(chosen) >= samples.shape[1]:
        raise ValueError(
            f"source: expected {max(chosen) + 1} numbers or more in a frame, as {INFO} says, got {samples.shape[1]}"
        )
    return samples[:, chosen]


def _times(frame: np.ndarray, timestamp: np.ndarray, fps: float) -> tuple[np.ndarray, str]:
    """Times of frames [s]: the exact multiples of 1 / fps that timestamps round, or else the timestamps; and a line."""
    exact = frame / fps
    if np.allclose(timestamp, exact, rtol=0, atol=_TIME_TOLERANCE):
        return exact, ""
    if len(timestamp) > 1 and not np.any(np.diff(timestamp) > 0):
        return exact, f"times: {fps:g} frames a second, since the timestamps do not increase"
    return timestamp, f"times: the timestamps, which are not those of {fps:g} frames a second"


def _read_frames(path: Path, features: Sequence[str]) -> tuple[np.ndarray, ...]:
    """Episode, frame, time and values of each feature, of each frame."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    files = sorted((path / DATA_FOLDER).glob("*/*.parquet"))
    names = ["episode_index", "frame_index", "timestamp", *features]
    if not files:
        raise ValueError(f"source: {str(path)!r} has no data, expected {DATA_FOLDER}/chunk-000/file-000.parquet")
    try:
        count = sum(_count_numbers(pq.read_metadata(check_file(file)), names) for file in files)
        if not 0 < count <= MAX_NUMBERS:
            raise ValueError(f"expected 1 to {MAX_NUMBERS:,} numbers, got {count:,}")
        tables = [pq.ParquetFile(file).read(columns=list(dict.fromkeys(names))) for file in files]
        columns = [np.concatenate([numbers(table[name]) for table in tables]) for name in names]
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise ValueError(f"source: the data of {str(path)!r} cannot be read: {_line(error)}") from error
    episode, frame, time, *values = columns
    vectors = (array.astype(float).reshape(len(time), -1) for array in values)
    return episode.astype(np.int64), frame.astype(np.int64), time.astype(float), *vectors


def _count_numbers(metadata: Any, names: Sequence[str]) -> int:
    """Numbers in some columns of a parquet file, before any are read: compressed, they may be a thousandth in size."""
    return sum(
        column.num_values
        for group in range(metadata.num_row_groups)
        for column in map(metadata.row_group(group).column, range(metadata.num_columns))
        if any(column.path_in_schema == name or column.path_in_schema.startswith(f"{name}.list.") for name in names)
    )


def _final_values(path: Path, feature: str) -> dict[int, np.ndarray]:
    """The state after the last frame of each episode; none where mimic has not written the dataset."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    final: dict[int, np.ndarray] = {}
    try:
        for file in sorted((path / EPISODES_FOLDER).glob("*/*.parquet")):
            if FINAL + feature in pq.read_schema(check_file(file)).names:
                table = pq.ParquetFile(file).read(columns=["episode_index", FINAL + feature])
                values = numbers(table[FINAL + feature]).reshape(table.num_rows, -1)
                final |= dict(zip(table["episode_index"].to_pylist(), values, strict=True))
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise ValueError(f"source: the episodes of {str(path)!r} cannot be read: {_line(error)}") from error
    return final


def numbers(column: Any) -> np.ndarray:
    """A column of numbers, or of lists of numbers, as one array; lists are [rows, numbers]."""
    import pyarrow as pa

    flat, rows = column.combine_chunks(), len(column)
    if flat.null_count:
        raise ValueError("expected numbers, got missing values")
    if pa.types.is_list(flat.type) or pa.types.is_large_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        lengths = np.unique(flat.value_lengths().to_numpy(zero_copy_only=False))
        if len(lengths) > 1:
            raise ValueError(f"expected lists of one length, got {lengths[0]} to {lengths[-1]} numbers")
        flat = flat.flatten()
    if not (pa.types.is_integer(flat.type) or pa.types.is_floating(flat.type)) or flat.null_count:
        raise ValueError(f"expected numbers, got {flat.type}")
    values = flat.to_numpy(zero_copy_only=False)
    return values.reshape(rows, -1) if len(values) > rows else values


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]
