"""Data sets of a real motion in five formats, and what goes wrong in data sets: of the numbers, and of the files."""

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.motions.evidence import hand_points
from tests.helpers.real_data import ROBOSUITE

ARM = mimic.panda()
RANGE = build_arm(ArmConfig(), "hardware").embodiment.joint_range
RATE, ROWS, EPISODES = 20, 150, 2
FORMATS = "v3.0", "v2.1", "hdf5", "csv", "npz"
Episode = dict[str, np.ndarray]  # time, qpos, qvel, gripper, action, hand


def real_episodes() -> list[Episode]:
    """Two parts of a recorded lift, with the hand's positions from kinematics, on a table and turned."""
    import h5py

    with h5py.File(ROBOSUITE / "lift/demo.hdf5") as file:
        states = np.asarray(file["data/demo_1/states"], float)
    joints, found = ARM.num_joints, []
    velocities = 1 + (states.shape[1] - 1 + 1) // 2  # nq is one more than nv, for the cube's quaternion
    for start in np.arange(EPISODES) * ROWS:
        rows = states[start : start + ROWS]
        qpos, after = rows[:, 1 : 1 + joints], np.minimum(np.arange(ROWS) + 2, ROWS - 1)
        hand = hand_points(ARM, qpos)[0] @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + [0.1, 0.2, 0.8]
        found.append({"time": np.arange(ROWS) / RATE, "qpos": qpos, "qvel": rows[:, velocities : velocities + joints],
                      "gripper": rows[:, 1 + joints : 2 + joints], "action": qpos[after], "hand": hand})  # fmt: skip
    return found


# --- writing ----------------------------------------------------------------------------------------------------------


def write(folder: Path, kind: str, episodes: list[Episode]) -> Path:
    """Writes the episodes in a format; returns the source."""
    if kind == "hdf5":
        return _write_hdf5(folder / "demo.hdf5", episodes)
    joined = {key: np.concatenate([episode[key] for episode in episodes]) for key in episodes[0]}
    names = [f"joint{number + 1}" for number in range(joined["qpos"].shape[1])]
    lengths = [len(episode["time"]) for episode in episodes]
    if kind == "csv":
        return _write_csv(folder / "data.csv", joined, names, lengths)
    if kind == "npz":
        others = {"eef_pos": joined["hand"]} if "hand" in joined else {}
        path, split = folder / "data.npz", np.cumsum([0, *lengths])
        dt = np.array(np.median(np.diff(episodes[0]["time"])))
        np.savez(path, qpos=joined["qpos"], qvel=joined["qvel"], joint_names=names, dt=dt, split_points=split, **others)  # type: ignore[arg-type]
        return path
    return _write_lerobot(folder, kind, episodes, names)


def _write_hdf5(path: Path, episodes: list[Episode]) -> Path:
    import h5py

    keys = {"qpos": "robot0_joint_pos", "qvel": "robot0_joint_vel", "gripper": "robot0_gripper_qpos"}
    keys |= {"hand": "robot0_eef_pos", "action": "target_joint_pos"}
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": RATE}})
        for number, episode in enumerate(episodes):
            group = file.create_group(f"data/demo_{number}")
            group.create_dataset("obs/time", data=episode["time"])
            for key in keys.keys() & episode.keys():
                group.create_dataset(f"obs/{keys[key]}", data=episode[key])
    return path


def _write_csv(path: Path, joined: Episode, names: list[str], lengths: list[int]) -> Path:
    columns = {"demonstration": np.repeat(np.arange(len(lengths)), lengths)[:, None], "time": joined["time"][:, None]}
    header = ["demonstration", "time", *names, *(f"dq_{name}" for name in names)]
    columns |= {key: joined[key] for key in ("qpos", "qvel", "gripper", "hand") if key in joined}
    header += ["gripper"] * ("gripper" in joined) + ["eef_x", "eef_y", "eef_z"] * ("hand" in joined)
    np.savetxt(path, np.concatenate(list(columns.values()), axis=1), "%.9g", ",", header=",".join(header), comments="")
    return path


def _write_lerobot(root: Path, version: str, episodes: list[Episode], names: list[str]) -> Path:
    import pyarrow as pa
    import pyarrow.parquet as pq

    has_gripper = "gripper" in episodes[0]
    names = [f"{name}.pos" for name in names] + ["gripper.pos"] * has_gripper
    vector = {"dtype": "float32", "shape": [len(names)], "names": names}
    features: dict[str, Any] = {"observation.state": vector, "action": vector}
    indices = "frame_index", "episode_index", "index"
    features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in indices}
    scalars = [key for key in episodes[0] if "." in key]  # such as next.reward
    features |= {name: {"dtype": "float32", "shape": [1], "names": None} for name in ("timestamp", *scalars)}
    if "hand" in episodes[0]:
        features["observation.ee_pos"] = {"dtype": "float32", "shape": [3], "names": ["x", "y", "z"]}
    lengths = [len(episode["time"]) for episode in episodes]
    info = {"codebase_version": version, "robot_type": "panda", "fps": RATE, "features": features,
            "total_episodes": len(episodes), "total_frames": sum(lengths), "splits": {}}  # fmt: skip
    (root / "meta").mkdir(parents=True)
    (root / "data/chunk-000").mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    tables = []
    for number, episode in enumerate(episodes):
        opening = [episode["gripper"]] if has_gripper else []
        vectors = {"observation.state": np.concatenate([episode["qpos"], *opening], axis=1),
                   "action": np.concatenate([episode["action"], *opening], axis=1)}  # fmt: skip
        if "hand" in episode:
            vectors["observation.ee_pos"] = episode["hand"]
        count = len(episode["time"])
        tables.append(pa.table({
            **{key: pa.array(list(x.astype(np.float32)), pa.list_(pa.float32())) for key, x in vectors.items()},
            "frame_index": np.arange(count), "episode_index": np.full(count, number),
            "index": sum(lengths[:number]) + np.arange(count),
            "timestamp": episode["time"].astype(np.float32),
            **{name: episode[name].astype(np.float32) for name in scalars},
        }))  # fmt: skip
    if version == "v2.1":
        for number, table in enumerate(tables):
            pq.write_table(table, root / f"data/chunk-000/episode_{number:06d}.parquet")
    else:
        pq.write_table(pa.concat_tables(tables), root / "data/chunk-000/file-000.parquet")
    return root


# --- corruptions of numbers -------------------------------------------------------------------------------------------


class Corruption(NamedTuple):
    """What is wrong with the numbers of a data set.

    Attributes:
      change: of each episode.
      line: a regular expression of the line that says so.
      options: of `read_data_set`.
      without: keys that are left out first, so that less is known.
      formats: in which it can happen.
    """

    change: Callable[[Episode], Mapping[str, np.ndarray]]
    line: str
    options: Mapping[str, Any] = {}
    without: tuple[str, ...] = ()
    formats: tuple[str, ...] = FORMATS


def of_joints(function: Callable[[np.ndarray], np.ndarray], *keys: str) -> Callable[[Episode], Episode]:
    """A change of the angles, or of other keys too."""
    return lambda episode: {key: function(episode[key]) for key in keys or ("qpos",)}


def _order(*order: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: values[:, list(order)]


def _signs(*joints: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: values * np.where(np.isin(np.arange(values.shape[1]), np.array(joints) - 1), -1, 1)


def _shifted(joint: int, degrees: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: values + np.radians(degrees) * (np.arange(values.shape[1]) == joint - 1)


def _at(row: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: np.where((np.arange(len(values)) == row)[:, None], value, values)


def _from(row: int, shift: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: values + shift * (np.arange(len(values)) >= row)[:, None]


def _frozen(joint: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: np.where(np.arange(values.shape[1]) == joint - 1, -1.5, values)


def _time(function: Callable[[np.ndarray], np.ndarray]) -> Callable[[Episode], Episode]:
    return lambda episode: {"time": function(episode["time"])}


EVERY = "qpos", "qvel", "action"  # all that has joints: only the hand knows better
NUMBERS = {
    "degrees for rad": Corruption(
        of_joints(np.degrees, *EVERY), "expected rad in|units=deg", {"units": ""}, formats=("csv",)
    ),
    "rad for degrees": Corruption(of_joints(lambda x: x), "no joint moves by more than", {"units": "deg"}),
    "two joints exchanged": Corruption(of_joints(_order(0, 1, 2, 5, 4, 3, 6)), "joint4, joint6 look exchanged"),
    "three joints exchanged": Corruption(of_joints(_order(1, 2, 0, 3, 4, 5, 6)), "joint1, joint2, joint3 look exch"),
    "joints reversed everywhere": Corruption(
        of_joints(_order(6, 5, 4, 3, 2, 1, 0), *EVERY), "do not fit the positions of the hand|look exchanged"
    ),
    "joints exchanged everywhere": Corruption(
        of_joints(_order(0, 3, 2, 1, 4, 5, 6), *EVERY), "joint2, joint4 look exchanged.* the positions of the hand"
    ),
    "a joint negated": Corruption(of_joints(_signs(4)), "joint4 looks negated"),
    "a joint negated everywhere": Corruption(of_joints(_signs(2), *EVERY), "joint2 looks negated, beside the posi"),
    "all joints negated": Corruption(of_joints(_signs(1, 2, 3, 4, 5, 6, 7)), "joint1, .*joint7 look negated"),
    "a joint negated, nothing else known": Corruption(
        of_joints(_signs(4), *EVERY), "beyond the range of the expert's model", without=("hand",)
    ),
    "a frozen joint": Corruption(of_joints(_frozen(4)), "joint4 never moves, at -1.5 rad"),
    "a shifted zero": Corruption(of_joints(_shifted(4, 20)), "the zero of joint4 looks (20|19.9|20.1) deg off"),
    "a shifted zero everywhere": Corruption(
        of_joints(_shifted(4, -7), "qpos", "action"), "the zero of joint4 looks -7.* deg"
    ),
    "times of half the rate": Corruption(
        _time(lambda time: 2 * time), "times those of the angles and times|not those of 20 frames"
    ),
    "doubled stamps": Corruption(_time(lambda time: np.repeat(time[::2], 2)), "repeated samples|not those of",
                                 formats=("v3.0", "v2.1", "hdf5", "csv")),
    "backward stamps": Corruption(_time(lambda time: time[::-1]), "time steps back|do not increase|that increase",
                                  formats=("v3.0", "v2.1", "csv")),
    "a sample without numbers": Corruption(of_joints(_at(9, np.nan)), "without numbers|not finite", formats=("npz",)),
    "no numbers": Corruption(of_joints(lambda x: np.nan * x), "no number as angle|not finite|no number"),
    "a jump": Corruption(of_joints(_from(70, 0.5)), "split where a joint jumps"),
    "a joint too few": Corruption(of_joints(lambda x: x[:, :6], *EVERY), "has no|expected|lacks|joint7|joints"),
    "no gripper": Corruption(lambda episode: {}, "gripper: none", without=("gripper",)),
}  # fmt: skip


def corrupted(corruption: Corruption, episodes: list[Episode]) -> list[Episode]:
    """The episodes with what is wrong."""
    kept = [{key: x for key, x in episode.items() if key not in corruption.without} for episode in episodes]
    return [episode | dict(corruption.change(episode)) for episode in kept]


# --- corruptions of files ---------------------------------------------------------------------------------------------


def _largest(source: Path) -> Path:
    files = [path for path in source.rglob("*") if path.is_file() and path.suffix != ".json"] or [source]
    return max(files, key=lambda path: path.stat().st_size)


def _cut(fraction: float) -> Callable[[Path], None]:
    def cut(source: Path) -> None:
        path = _largest(source)
        path.write_bytes(path.read_bytes()[: int(fraction * path.stat().st_size)])

    return cut


def _edited_info(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def edit(source: Path) -> None:
        path = source / "meta/info.json"
        info = json.loads(path.read_text())
        change(info)
        path.write_text(json.dumps(info))

    return edit


def _with_video(info: dict[str, Any]) -> None:
    info["features"]["observation.images.front"] = {"dtype": "video", "shape": [4, 4, 3], "names": ["h", "w", "c"]}


LEROBOT = "v3.0", "v2.1"
FILES: dict[str, tuple[Callable[[Path], Any], str, tuple[str, ...]]] = {
    "cut at the end": (_cut(0.99), "source: ", ("v3.0", "v2.1", "hdf5", "npz")),
    "cut within a row": (_cut(0.7003), "source: |row", ("csv",)),
    "empty": (lambda source: _largest(source).write_bytes(b""), "source: ", ("npz",)),
    "garbage": (lambda source: _largest(source).write_bytes(b"\x00x\xff" * 999), "source: ", FORMATS),
    "no meta": (lambda source: shutil.rmtree(source / "meta"), "source: expected a folder|source: ", LEROBOT),
    "no rate": (_edited_info(lambda info: info.pop("fps")), "fps", LEROBOT),
    "another rate": (_edited_info(lambda info: info.update(fps=50)), "not those of 50 frames a second", LEROBOT),
    "episodes missing": (_edited_info(lambda info: info.update(total_episodes=9)), "states 9 episodes, the data has 2",
                         LEROBOT),
    "frames missing": (_edited_info(lambda info: info.update(total_frames=999)), "states 999 frames, the data has",
                       LEROBOT),
    "no videos": (_edited_info(_with_video), "videos of observation.images.front are missing", LEROBOT),
    "no data": (lambda source: shutil.rmtree(source / "data"), "has no data", LEROBOT),
}  # fmt: skip
