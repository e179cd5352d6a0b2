"""Writes a LeRobot dataset, version 3.0: https://huggingface.co/docs/lerobot/lerobot-dataset-v3.

Each frame is a state and what was commanded in it. An episode of T steps has T frames; the state after the last one is
in the episode's metadata, as `final/FEATURE`.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mimic.motions.formats.episodes import ANGLE, EXPERT, VELOCITY, ArmMotions, Episodes, Quantity

VERSION = "v3.0"
INFO, STATS, TASKS, MIMIC = "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/mimic.json"
DATA_FOLDER, EPISODES_FOLDER = "data", "meta/episodes"
STATE, EXPERT_STATE, ACTION = "observation.state", "observation.environment_state", "action"
FINAL = "final/"  # before the name of a feature, in the metadata of episodes
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_FILES_IN_CHUNK, FILE_BYTES = 1000, 100 * 2**20  # LeRobot's own limits
_INDICES = ("frame_index", "episode_index", "index", "task_index")
_QUANTILES = (1, 10, 50, 90, 99)  # percent
_MEANINGS = {
    STATE: "the robot's joint angles and velocities at the start of the step",
    EXPERT_STATE: "those of the expert, which the robot imitates, at the same time",
}


def frames_per_second(dt: float) -> int:
    """The rate of a dataset with a time step [s].

    Raises:
      ValueError: it is no whole number, which LeRobot requires.
    """
    rate = round(1 / dt)
    if rate < 1 or abs(rate * dt - 1) > 1e-6:
        raise ValueError(
            f"format=lerobot: expected a time step of 1/N s, as LeRobot counts whole frames per second, got {dt:g} s; "
            "format=rosbag2 takes any"
        )
    return rate


def write_lerobot(folder: Path, episodes: Episodes) -> None:
    """Writes a dataset into an empty folder. Needs pyarrow.

    Raises:
      ValueError: a time step that LeRobot does not have.
    """
    import pyarrow.parquet as pq

    fps = frames_per_second(episodes.dt)
    features, arrays = _features(episodes), _columns(episodes, fps)
    lengths = np.asarray(episodes.steps)
    ends = np.cumsum(lengths)
    starts = ends - lengths
    files = _file_of_episode(lengths, sum(array[0].nbytes for array in arrays.values()))
    for file in np.unique(files):
        inside = np.flatnonzero(files == file)
        rows = slice(starts[inside[0]], ends[inside[-1]])
        table = _table({name: array[rows] for name, array in arrays.items()})
        pq.write_table(table, _new_file(folder / DATA_FOLDER, file))
    pq.write_table(_episode_table(episodes, arrays, starts, ends, files), _new_file(folder / EPISODES_FOLDER, 0))
    pq.write_table(_task_table([episodes.task]), folder / TASKS)
    stats = {name: statistics(array) for name, array in arrays.items()}
    info = {
        "codebase_version": VERSION,
        "robot_type": episodes.robot.arm,
        "total_episodes": len(lengths),
        "total_frames": int(ends[-1]),
        "total_tasks": 1,
        "chunks_size": _FILES_IN_CHUNK,
        "data_files_size_in_mb": FILE_BYTES // 2**20,
        "video_files_size_in_mb": 200,  # there are no videos, but the key is required
        "fps": fps,
        "splits": {split: f"{first}:{end}" for split, (first, end) in episodes.ranges.items()},
        "data_path": f"{DATA_FOLDER}/{_FILE}",
        "video_path": None,
        "features": features,
    }
    for name, content in ((INFO, info), (STATS, stats), (MIMIC, _provenance(episodes))):
        (folder / name).write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")


def action_of(motions: ArmMotions) -> tuple[np.ndarray, Quantity, str]:
    """The actions [episodes, steps, joints] of an arm, what they are, and that in words.

    Where no command is known, the action is the pose to reach: the angles of the next sample.
    """
    if motions.command is None:
        return motions.qpos[:, 1:], ANGLE, "the robot's joint angles at the end of the step: no command is known"
    return motions.command, motions.quantity, "commanded; constant in the step"


def _features(episodes: Episodes) -> dict[str, dict[str, Any]]:
    """The columns of the data, as info.json describes them."""
    robot, expert = episodes.robot, episodes.expert
    features = {STATE: _joint_feature(robot.joint_names, (ANGLE, VELOCITY), robot.gripper_names)}
    if expert is not None:
        names = [EXPERT + name for name in expert.joint_names]
        gripper = [EXPERT + name for name in expert.gripper_names]
        features[EXPERT_STATE] = _joint_feature(names, (ANGLE, VELOCITY), gripper)
    commanded = () if robot.gripper_command is None else robot.gripper_names
    features[ACTION] = _joint_feature(robot.joint_names, (action_of(robot)[1],), commanded)
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None, "units": ["s"]}
    return features | {name: {"dtype": "int64", "shape": [1], "names": None} for name in _INDICES}


def _joint_feature(
    joints: Sequence[str], quantities: Sequence[Quantity], gripper: Sequence[str] = ()
) -> dict[str, Any]:
    names = [f"{joint}.{quantity.name}" for quantity in quantities for joint in joints]
    names += [f"{name}.{ANGLE.name}" for name in gripper]
    units = [quantity.unit for quantity in quantities for _ in joints]  # LeRobot has no place for units
    return {"dtype": "float32", "shape": [len(names)], "names": names, "units": units + [""] * len(gripper)}


def _columns(episodes: Episodes, fps: int) -> dict[str, np.ndarray]:
    """The values of each feature in all frames, [frames, numbers]."""
    steps = episodes.steps
    values = {STATE: _states(episodes.robot)}
    if episodes.expert is not None:
        values[EXPERT_STATE] = _states(episodes.expert)
    gripper = episodes.robot.gripper_command
    values[ACTION] = np.concatenate([action_of(episodes.robot)[0], *([] if gripper is None else [gripper])], axis=-1)
    columns = {
        name: np.concatenate([array[: steps[i]] for i, array in enumerate(all_steps)]).astype(np.float32)
        for name, all_steps in values.items()
    }
    frame = np.concatenate([np.arange(count) for count in steps])
    indices = (frame, np.repeat(np.arange(len(steps)), steps), np.arange(len(frame)), np.zeros(len(frame)))
    columns["timestamp"] = (frame / fps).astype(np.float32)[:, None]
    return columns | {name: index.astype(np.int64)[:, None] for name, index in zip(_INDICES, indices, strict=True)}


def _states(motions: ArmMotions) -> np.ndarray:
    parts = [motions.qpos, motions.qvel, *([] if motions.gripper is None else [motions.gripper])]
    return np.concatenate(parts, axis=-1)


def _file_of_episode(lengths: np.ndarray, frame_bytes: int) -> np.ndarray:
    """The number of the file of each episode, from 0: a new one where the last is full."""
    before = np.cumsum(lengths) - lengths
    return np.unique((before * frame_bytes) // FILE_BYTES, return_inverse=True)[1]


def _new_file(folder: Path, number: int) -> Path:
    path = folder / _FILE.format(chunk_index=number // _FILES_IN_CHUNK, file_index=number % _FILES_IN_CHUNK)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _table(columns: Mapping[str, np.ndarray]) -> Any:
    """An Arrow table; a feature of one number is a scalar, as LeRobot has it, and others are lists of a fixed size."""
    import pyarrow as pa

    def column(values: np.ndarray) -> Any:
        flat = pa.array(np.ascontiguousarray(values).ravel())
        return flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])

    return pa.table({name: column(values) for name, values in columns.items()})


def _episode_table(
    episodes: Episodes, arrays: Mapping[str, np.ndarray], starts: np.ndarray, ends: np.ndarray, files: np.ndarray
) -> Any:
    """The metadata of the episodes: where each is, its statistics, and its last state."""
    import pyarrow as pa

    count = len(starts)
    stats = [
        {
            f"stats/{name}/{key}": value
            for name, array in arrays.items()
            for key, value in statistics(array[start:end]).items()
        }
        for start, end in zip(starts, ends, strict=True)
    ]
    columns: dict[str, Any] = {
        "episode_index": range(count),
        "tasks": [[episodes.task]] * count,
        "length": ends - starts,
        "data/chunk_index": files // _FILES_IN_CHUNK,
        "data/file_index": files % _FILES_IN_CHUNK,
        "dataset_from_index": starts,
        "dataset_to_index": ends,
        **{key: [row[key] for row in stats] for key in stats[0]},
        "meta/episodes/chunk_index": [0] * count,
        "meta/episodes/file_index": [0] * count,
        "split": list(episodes.splits),
        "demonstration": list(episodes.numbers),
        **{FINAL + name: list(states) for name, states in _final_states(episodes)},
    }
    return pa.table({name: pa.array(values) for name, values in columns.items()})


def _final_states(episodes: Episodes) -> Iterator[tuple[str, np.ndarray]]:
    """The state of each episode after its last step, by feature."""
    for name, motions in ((STATE, episodes.robot), (EXPERT_STATE, episodes.expert)):
        if motions is not None:
            states = _states(motions).astype(np.float32)
            yield name, states[np.arange(len(states)), np.asarray(episodes.steps)]


def _task_table(tasks: Sequence[str]) -> Any:
    """The tasks. LeRobot reads this file with pandas and looks a task up in the index, which the metadata declares."""
    import pyarrow as pa

    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": list(tasks)})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": dtype, "metadata": None}
        for name, kind, dtype in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def statistics(values: np.ndarray) -> dict[str, list[Any]]:
    """Statistics of a feature over frames, in double precision; the standard deviation is that of the values."""
    exact = values.astype(np.float64)
    quantiles = np.percentile(exact, _QUANTILES, axis=0)
    return {
        "min": values.min(axis=0).tolist(),
        "max": values.max(axis=0).tolist(),
        "mean": exact.mean(axis=0).tolist(),
        "std": exact.std(axis=0).tolist(),
        "count": [len(values)],
        **{f"q{percent:02d}": row.tolist() for percent, row in zip(_QUANTILES, quantiles, strict=True)},
    }


def _provenance(episodes: Episodes) -> dict[str, Any]:
    """What LeRobot's metadata have no place for."""
    robot, expert = episodes.robot, episodes.expert
    meanings = {**_MEANINGS, ACTION: action_of(robot)[2]}
    if expert is None:
        del meanings[EXPERT_STATE]
    return {
        **episodes.provenance,
        "robot": robot.arm,
        "expert": None if expert is None else expert.arm,
        "time_step_s": episodes.dt,
        "meaning": meanings,
        "final": f"the columns {FINAL}FEATURE of {EPISODES_FOLDER} are the states after the last step",
    }
