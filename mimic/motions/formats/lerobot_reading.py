"""Reads joint motions from a LeRobot dataset, version 3."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mimic.base.files import check_file, read_json
from mimic.motions.formats.episodes import ANGLE, EXPERT, MAX_NUMBERS, VELOCITY, Motion, choose_entry, package_error
from mimic.motions.formats.lerobot import DATA_FOLDER, EPISODES_FOLDER, FINAL, INFO

_TIME_TOLERANCE = 1e-4  # s: LeRobot's own, between a timestamp and that of its frame
_FLOATS = ("float32", "float64")


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (path / INFO).is_file()


def read_lerobot(path: Path, joints: Sequence[str], feature: str = "") -> list[Motion]:
    """The motions of joints, one for each episode. Needs pyarrow.

    Joints are found by their names in info.json: NAME.pos or NAME for the angle, NAME.vel for the velocity. Where
    mimic wrote the dataset, the state after the last frame is included.

    Args:
      path: folder of the dataset.
      joints: names of the joints, base to tip.
      feature: feature that has them; empty for the only one that does.

    Raises:
      ValueError: a folder that cannot be read, or that lacks the joints or has them in several features.
    """
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise package_error(f"source: {str(path)!r} is a LeRobot dataset, which", "pyarrow") from error
    try:
        info = read_json(path / INFO)
        fps, entries = _check_info(info), _joint_names(info["features"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"source: {str(path / INFO)!r} cannot be read: {_line(error)}") from error
    angles = {name: list(addresses[ANGLE.name]) for name, addresses in entries.items() if addresses[ANGLE.name]}
    feature = choose_entry(str(path), angles, joints, feature, "feature")
    episode, frame, time, values = _read_frames(path, feature)
    order = np.lexsort((frame, episode))
    numbers, starts = np.unique(episode[order], return_index=True)
    final, columns = _final_values(path, feature), entries[feature]
    motions = []
    for number, rows in zip(numbers, np.split(order, starts[1:]), strict=True):
        times = _times(frame[rows], time[rows], fps)
        samples = values[rows]
        if int(number) in final:
            times, samples = np.append(times, times[-1] + 1 / fps), np.vstack([samples, final[int(number)]])
        qpos, qvel = (_select(samples, columns[quantity.name], joints) for quantity in (ANGLE, VELOCITY))
        assert qpos is not None  # `choose_entry` has checked it
        motions.append(Motion(times, qpos, qvel))
    return motions


def _check_info(info: Mapping[str, Any]) -> float:
    """The frames per second of a dataset of version 3."""
    version, fps = info.get("codebase_version"), info.get("fps")
    if not str(version).startswith("v3."):
        raise ValueError(f"expected codebase_version v3.0, got {version!r:.80}; LeRobot converts older datasets")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 1e-3 <= fps <= 1e6:
        raise ValueError(f"expected frames per second in [0.001, 1e6] as fps, got {fps!r:.80}")
    return float(fps)


def _joint_names(features: Mapping[str, Any]) -> dict[str, dict[str, dict[str, int]]]:
    """The columns of angles and of velocities by joint, for each feature that is a vector of named numbers."""
    entries: dict[str, dict[str, dict[str, int]]] = {}
    for feature, form in features.items():
        names, shape = form.get("names"), form["shape"]
        if isinstance(names, Mapping) and len(names) == 1:  # {"motors": [...]}, as older datasets have it
            names = next(iter(names.values()))
        if form["dtype"] not in _FLOATS or not isinstance(names, list | tuple) or list(shape) != [len(names)]:
            continue
        found: dict[str, dict[str, int]] = {ANGLE.name: {}, VELOCITY.name: {}}
        for column, name in enumerate(map(str, names)):
            joint, _, quantity = name.rpartition(".")
            if not joint or quantity not in found:
                joint, quantity = name, ANGLE.name
            found[quantity][joint.removeprefix(EXPERT)] = column
        entries[str(feature)] = found
    return entries


def _select(samples: np.ndarray, columns: Mapping[str, int], joints: Sequence[str]) -> np.ndarray | None:
    """The columns of joints; None where one has no such column."""
    return samples[:, [columns[joint] for joint in joints]] if set(joints) <= set(columns) else None


def _times(frame: np.ndarray, timestamp: np.ndarray, fps: float) -> np.ndarray:
    """Times of frames [s]: the exact multiples of 1 / fps that timestamps round, or else the timestamps."""
    exact = frame / fps
    return exact if np.allclose(timestamp, exact, rtol=0, atol=_TIME_TOLERANCE) else timestamp


def _read_frames(path: Path, feature: str) -> tuple[np.ndarray, ...]:
    """Episode, frame, time and values of each frame."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    files = sorted((path / DATA_FOLDER).glob("*/*.parquet"))
    names = ["episode_index", "frame_index", "timestamp", feature]
    if not files:
        raise ValueError(f"source: {str(path)!r} has no data, expected {DATA_FOLDER}/chunk-000/file-000.parquet")
    try:
        count = sum(_count_numbers(pq.read_metadata(check_file(file)), names) for file in files)
        if not 0 < count <= MAX_NUMBERS:
            raise ValueError(f"expected 1 to {MAX_NUMBERS:,} numbers, got {count:,}")
        tables = [pq.ParquetFile(file).read(columns=names) for file in files]
        columns = [np.concatenate([_numbers(table[name]) for table in tables]) for name in names]
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise ValueError(f"source: the data of {str(path)!r} cannot be read: {_line(error)}") from error
    episode, frame, time, values = columns
    return episode.astype(np.int64), frame.astype(np.int64), time.astype(float), values.reshape(len(time), -1)


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
                values = _numbers(table[FINAL + feature]).reshape(table.num_rows, -1)
                final |= dict(zip(table["episode_index"].to_pylist(), values, strict=True))
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise ValueError(f"source: the episodes of {str(path)!r} cannot be read: {_line(error)}") from error
    return final


def _numbers(column: Any) -> np.ndarray:
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
