"""Writes a LeRobot dataset, version 2 or 3, again for another arm; other features and videos stay as they are."""

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mimic.base.files import check_file, copy_file, read_json, read_text
from mimic.motions.formats.episodes import ANGLE
from mimic.motions.formats.lerobot import DATA_FOLDER, EPISODES_FOLDER, INFO, STATS, statistics
from mimic.motions.formats.lerobot_reading import FINAL, feature_names, missing_videos, numbers
from mimic.motions.formats.names import is_copy, numbers_joints, parse_column, quantity_of
from mimic.motions.formats.replacing import Column, Replacement, replaced_columns, replaced_values

_LINES, _STATS_LINES = "meta/episodes.jsonl", "meta/episodes_stats.jsonl"  # of version 2: a line for each episode
_EPISODE = "episode "  # of the names of motions, before their numbers
_Arrays = dict[str, np.ndarray]


class _Plan:
    """What becomes of the features and the episodes of a dataset."""

    def __init__(self, info: Mapping[str, Any], replacement: Replacement):
        self.replacement = replacement
        self.features: dict[str, Any] = dict(info["features"])
        self.columns: dict[str, list[Column]] = {}
        self.whose = {entry: entry for entry in replacement.old_joints}  # entry of the motions that a feature has
        self.dropped: list[str] = []
        for entry, joints in replacement.old_joints.items():
            names = feature_names(self.features[entry])
            of_gripper, gripper = replacement.grippers.get(entry, ("", ()))
            own = gripper if of_gripper == entry else ()
            self.columns[entry], dropped = replaced_columns(names, joints, replacement.joints, own)
            if gripper and not own and of_gripper not in self.whose:
                self.whose[of_gripper] = entry
                self.columns[of_gripper], _ = replaced_columns(
                    feature_names(self.features[of_gripper]), (), (), gripper
                )
            self.dropped += [f"{name} of {entry}" for name in dropped]
            self.features[entry] = _description(self.features[entry], self.columns[entry])
        joints = [joint for found in replacement.old_joints.values() for joint in found]
        self.left_out = [
            name for name, form in self.features.items() if name not in self.columns and _is_of(name, form, joints)
        ]
        self.dropped += self.left_out
        self.features = {name: form for name, form in self.features.items() if name not in self.left_out}
        kept = sorted(int(name.removeprefix(_EPISODE)) for name in replacement.kept)
        self.new_number = {old: new for new, old in enumerate(kept)}
        self.values: dict[int, _Arrays] = {}  # of the replaced features, by the old number of the episode
        self.final: dict[int, _Arrays] = {}  # the same after the last frame, where that is known
        self.starts: dict[int, int] = {}  # the new number of each episode's first frame
        self.frames = 0

    def replaced(self, entry: str, old: int, values: np.ndarray) -> np.ndarray:
        """The new values of a feature in the frames of an episode."""
        motion, count = self.replacement.motions[self.whose[entry]][f"{_EPISODE}{old}"], len(values)
        rows = np.minimum(np.arange(len(motion.time)), count - 1)
        every = replaced_values(values[rows], self.columns[entry], motion)
        if len(motion.time) > count:
            self.final.setdefault(old, {})[entry] = every[-1]
        return every[:count]

    def add(self, old: int, values: _Arrays, count: int) -> int:
        """Notes the values of an episode; returns the number of its first frame."""
        self.values[old], self.starts[old] = values, self.frames
        self.frames += count
        return self.starts[old]


def rewrite_lerobot(source: Path, out: Path, replacement: Replacement) -> list[str]:
    """Writes the dataset into an empty folder, with episodes numbered anew and statistics of the new values.

    Returns:
      The names of columns and features that are left out: torques and other values of the expert's joints.
    """
    info = read_json(source / INFO)
    plan = _Plan(info, replacement)
    for name in missing_videos(source, plan.features):
        del plan.features[name]  # LeRobot opens no dataset without them
    is_old = str(info["codebase_version"]).startswith("v2.")
    _write_data(source, out, plan, is_old)
    (_write_lines if is_old else _write_episodes)(source, out, plan)
    _copy_others(source, out, plan)
    count = len(plan.new_number)
    videos = [name for name, form in plan.features.items() if form.get("dtype") == "video"]
    info |= {"robot_type": replacement.robot, "features": plan.features, "total_episodes": count}
    info |= {"total_frames": plan.frames, "splits": _splits(info.get("splits") or {}, plan.new_number)}
    if is_old and "total_videos" in info:
        info["total_videos"] = count * len(videos)
    _write_json(out / INFO, info)
    if (source / STATS).is_file():
        stats = read_json(source / STATS)
        for name in plan.columns:
            whole = np.concatenate([arrays[name] for arrays in plan.values.values()])
            stats[name] = _alike(statistics(whole), stats.get(name, {}))
        stats = {name: value for name, value in stats.items() if name not in plan.left_out}
        _write_json(out / STATS, stats)
    return plan.dropped


def _is_of(feature: str, form: Mapping[str, Any], joints: Sequence[str]) -> bool:
    """Whether a feature that is not replaced has values of the expert's joints, such as velocities."""
    names = [] if form.get("dtype") == "video" else feature_names(form)
    if numbers_joints([*joints, *names]):
        return quantity_of(feature) != ANGLE
    found = [parse_column(name).joint for name in names]
    return any(name in joints or is_copy(name, joints) for name in found)


def _description(form: Mapping[str, Any], columns: Sequence[Column]) -> dict[str, Any]:
    """A feature in info.json with its new columns, nested as the old ones."""
    old, names = form.get("names"), [column.name for column in columns]
    nested: Any = names
    if isinstance(old, Mapping):
        is_index = all(isinstance(value, int) for value in old.values())
        nested = {name: index for index, name in enumerate(names)} if is_index else dict.fromkeys(old, names)
    elif isinstance(old, list | tuple) and len(old) == 1 and isinstance(old[0], list | tuple):
        nested = [names]
    changed = {**form, "names": None if old is None else nested, "shape": [len(names)]}
    if form.get("units"):
        changed["units"] = [form["units"][column.index] for column in columns]
    return changed


def _write_data(source: Path, out: Path, plan: _Plan, is_old: bool) -> None:
    """Writes the frames of the kept episodes, file by file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    for file in sorted((source / DATA_FOLDER).glob("*/*.parquet")):
        table = pq.ParquetFile(check_file(file)).read()
        episode = numbers(table["episode_index"]).astype(int)
        table = table.filter(pa.array(np.isin(episode, list(plan.new_number))))
        if not table.num_rows:
            continue
        episode = numbers(table["episode_index"]).astype(int)
        index, new = np.zeros(len(episode), int), {name: [] for name in plan.columns}
        for old, rows in _runs(episode):
            arrays = {
                name: plan.replaced(name, old, numbers(table[name]).reshape(len(episode), -1)[rows])
                for name in plan.columns
            }
            index[rows] = plan.add(old, arrays, rows.stop - rows.start) + np.arange(rows.stop - rows.start)
            for name, values in arrays.items():
                new[name].append(values)
        table = table.drop_columns([name for name in plan.left_out if name in table.column_names])
        for name, parts in new.items():
            table = _with_column(table, name, np.concatenate(parts))
        table = _with_column(table, "episode_index", np.array([plan.new_number[old] for old in episode]))
        table = _with_column(table, "index", index) if "index" in table.column_names else table
        path = out / file.relative_to(source)
        if is_old:
            path = path.with_name(_renumbered(path.name, episode[0], plan))
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(_with_lengths(table, plan), path)


def _runs(episode: np.ndarray) -> Iterator[tuple[int, slice]]:
    """Each episode in a file, and its rows."""
    edges = [0, *(np.flatnonzero(np.diff(episode)) + 1), len(episode)]
    for start, stop in itertools.pairwise(edges):
        yield int(episode[start]), slice(int(start), int(stop))


def _with_column(table: Any, name: str, values: np.ndarray) -> Any:
    """The table with other values in a column, of the same type but for the length of lists."""
    import pyarrow as pa

    place, old = table.column_names.index(name), table.schema.field(name)
    kind = old.type
    if not (pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)):
        column = pa.array(values.ravel(), kind)
    else:
        flat = pa.array(np.ascontiguousarray(values).ravel(), kind.value_type)
        column = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        if not pa.types.is_fixed_size_list(kind):
            column = column.cast(kind)
    return table.set_column(place, pa.field(name, column.type, old.nullable, old.metadata), column)


def _with_lengths(table: Any, plan: _Plan) -> Any:
    """The table with the lengths of the new features in the metadata that the package `datasets` reads."""
    metadata = dict(table.schema.metadata or {})
    if b"huggingface" in metadata:
        content = json.loads(metadata[b"huggingface"])
        features = content.get("info", {}).get("features", {})
        for name in plan.left_out:
            features.pop(name, None)
        for name, columns in plan.columns.items():
            if features.get(name, {}).get("length", -1) > 0:
                features[name]["length"] = len(columns)
        metadata[b"huggingface"] = json.dumps(content).encode()
    return table.replace_schema_metadata(metadata)


def _write_episodes(source: Path, out: Path, plan: _Plan) -> None:
    """Writes the metadata of episodes, version 3."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    for file in sorted((source / EPISODES_FOLDER).glob("*/*.parquet")):
        table = pq.ParquetFile(check_file(file)).read()
        old = numbers(table["episode_index"]).astype(int)
        kept = np.isin(old, list(plan.new_number))
        table, old = table.filter(pa.array(kept)), old[kept]
        gone = tuple(part for name in plan.left_out for part in (f"{FINAL}{name}", f"stats/{name}/"))
        table = table.drop_columns([key for key in table.column_names if key.startswith(gone)])
        starts = np.array([plan.starts[number] for number in old])
        changed = {
            "episode_index": np.array([plan.new_number[number] for number in old]),
            "dataset_from_index": starts,
            "dataset_to_index": starts + np.array([len(next(iter(plan.values[number].values()))) for number in old]),
        }
        for name, values in changed.items():
            table = _with_column(table, name, values) if name in table.column_names else table
        for name in plan.columns:
            if FINAL + name in table.column_names:
                table = _with_column(table, FINAL + name, np.array([plan.final[number][name] for number in old]))
            for key in statistics(np.zeros((1, 1))):
                column = f"stats/{name}/{key}"
                if column in table.column_names and len(old):
                    values = np.array([statistics(plan.values[number][name])[key] for number in old])
                    table = _with_column(table, column, values)
        (out / file.relative_to(source)).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, out / file.relative_to(source))


def _write_lines(source: Path, out: Path, plan: _Plan) -> None:
    """Writes the metadata of episodes, version 2."""
    for name in (_LINES, _STATS_LINES):
        if not (source / name).is_file():
            continue
        rows = [json.loads(line) for line in read_text(source / name).splitlines() if line.strip()]
        rows = [row for row in rows if row["episode_index"] in plan.new_number]
        for row in rows:
            for feature in plan.left_out if "stats" in row else ():
                row["stats"].pop(feature, None)
            for feature in plan.columns if "stats" in row else ():
                values = plan.values[row["episode_index"]][feature]
                row["stats"][feature] = _alike(statistics(values), row["stats"].get(feature, {}))
            row["episode_index"] = plan.new_number[row["episode_index"]]
        path = out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


def _alike(stats: Mapping[str, Any], old: Mapping[str, Any]) -> dict[str, Any]:
    """The statistics that the old ones have; all where there were none."""
    return {key: value for key, value in stats.items() if not old or key in old}


def _copy_others(source: Path, out: Path, plan: _Plan) -> None:
    """Copies all files that are not written anew; videos of one episode each get its new number."""
    for file in source.rglob("*"):
        path = out / file.relative_to(source)
        parts = file.relative_to(source).parts
        if not file.is_file() or parts[0] == DATA_FOLDER or path.exists() or str(Path(*parts)) in (INFO, STATS):
            continue
        if found := [old for old in plan.new_number if f"episode_{old:06d}" in (file.stem, file.parent.name)]:
            path = Path(_renumbered(str(path), found[0], plan))
        elif "episode_" in file.name or file.parent.name.startswith("episode_"):
            continue  # of an episode that is left out
        path.parent.mkdir(parents=True, exist_ok=True)
        copy_file(file, path)


def _renumbered(name: str, old: int, plan: _Plan) -> str:
    return name.replace(f"episode_{old:06d}", f"episode_{plan.new_number[old]:06d}")


def _splits(splits: Mapping[str, Any], new_number: Mapping[int, int]) -> dict[str, str]:
    """The splits with the episodes that are kept."""
    found = {}
    for name, text in splits.items():
        first, _, end = str(text).partition(":")
        if not (first.isdigit() and end.isdigit()):
            continue
        inside = [new for old, new in new_number.items() if int(first) <= old < int(end)]
        found[name] = f"{min(inside)}:{max(inside) + 1}" if inside else "0:0"
    return found


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")
