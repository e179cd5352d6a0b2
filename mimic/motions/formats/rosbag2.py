"""Reads and writes joint motions as rosbag2, the recordings of ROS 2: https://github.com/ros2/rosbag2.

Messages are sensor_msgs/JointState, in rad, rad/s and N m. A bag is one motion; a dataset is a folder of bags.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mimic.base.files import check_file, check_folder
from mimic.motions.formats.episodes import (
    ANGLE,
    MAX_NUMBERS,
    TORQUE,
    VELOCITY,
    ArmMotions,
    Episodes,
    Motion,
    choose_entry,
    package_error,
)

METADATA, BAG = "metadata.yaml", "episode_{:06d}"
BAG_FILES = (".db3", ".mcap")  # a bag that is one file
START = 10**9  # ns, the time of the first sample: a stamp of 0 means none in ROS
_TYPE = "sensor_msgs/msg/JointState"
_STATES, _COMMANDS = "joint_states", "joint_commands"
_VERSION = 8  # of the format: that of ROS 2 Iron and Jazzy
_FIELD = {ANGLE: "position", VELOCITY: "velocity", TORQUE: "effort"}  # of a message, for each kind of command
_MAX_BAGS = 100_000
_FLOATS_OF_JOINT = 3  # in a message


def write_rosbag2(folder: Path, episodes: Episodes) -> None:
    """Writes a bag for each episode into an empty folder. Needs rosbags.

    Topics: /joint_states and /joint_commands, with the prefixes /learner and /expert where both arms are known. Bags
    begin at 1 s.

    Args:
      folder: the folder.
      episodes: the motions.
    """
    from rosbags.rosbag2 import Writer

    for index in range(len(episodes.steps)):
        with Writer(folder / BAG.format(index), version=_VERSION) as writer:
            for key, value in _custom_data(episodes, index).items():
                writer.set_custom_data(key, value)
            _write_episode(writer, episodes, index)


def _write_episode(writer: Any, episodes: Episodes, index: int) -> None:
    """Writes the messages of an episode in the order of their times."""
    store = _type_store()
    message_types = {name: store.types[name] for name in (_TYPE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")}
    joint_state, header, time = message_types.values()
    topics = {
        topic: (motions, fields, writer.add_connection(topic, _TYPE, typestore=store))
        for topic, motions, fields in _topics(episodes, index)
    }
    none = np.zeros(0)
    for sample in range(episodes.steps[index] + 1):
        stamp = START + round(sample * episodes.dt * 1e9)
        for motions, fields, connection in topics.values():
            values = {field: array[sample] for field, array in fields.items() if sample < len(array)}
            if not values:
                continue  # no command after the last step
            message = joint_state(
                header(time(stamp // 10**9, stamp % 10**9), frame_id=""),
                name=list(motions.joint_names),
                **{field: values.get(field, none) for field in _FIELD.values()},
            )
            writer.write(connection, stamp, store.serialize_cdr(message, _TYPE))


def _topics(episodes: Episodes, index: int) -> Iterator[tuple[str, ArmMotions, dict[str, np.ndarray]]]:
    """Topics with their arm and the values of each field of their messages [samples, joints], of one episode."""
    arms = {"": episodes.robot}
    if episodes.expert is not None:
        arms = {"/expert": episodes.expert, "/learner": episodes.robot}
    steps = episodes.steps[index]
    for prefix, motions in arms.items():
        states = {"position": motions.qpos[index], "velocity": motions.qvel[index]}
        yield f"{prefix}/{_STATES}", motions, {field: _floats(array[: steps + 1]) for field, array in states.items()}
        if motions.command is not None:
            commands = {_FIELD[motions.quantity]: _floats(motions.command[index][:steps])}
            yield f"{prefix}/{_COMMANDS}", motions, commands


def _floats(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float64)


def _custom_data(episodes: Episodes, index: int) -> dict[str, str]:
    """The custom data of a bag: what it is from, and what its messages mean."""
    facts = {
        **episodes.provenance,
        "task": episodes.task,
        "split": episodes.splits[index],
        "demonstration": episodes.numbers[index],
        "robot": episodes.robot.arm,
        "expert": "" if episodes.expert is None else episodes.expert.arm,
        "time_step_s": episodes.dt,
        "units": "position rad, velocity rad/s, effort N m",
    }
    return {key: str(value) for key, value in facts.items()}


def _type_store() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def is_rosbag2(path: Path) -> bool:
    """Whether a path is a bag, or a folder of bags."""
    return path.suffix in BAG_FILES if path.is_file() else bool(_bags(path))


def _bags(path: Path) -> list[Path]:
    if path.is_file() or (path / METADATA).is_file():
        return [path]
    return sorted(child.parent for child in path.glob(f"*/{METADATA}")) if path.is_dir() else []


def read_rosbag2(path: Path, joints: Sequence[str], topic: str = "") -> list[Motion]:
    """The motions of joints, one for each bag. Needs rosbags.

    Times are those of the messages' headers, or when the messages were recorded where a header has none. A message
    without all joints is left out.

    Args:
      path: a bag, or a folder of bags.
      joints: names of the joints, base to tip.
      topic: topic of sensor_msgs/JointState that has them; empty for the only one that does.

    Raises:
      ValueError: a bag that cannot be read, or that lacks the joints or has them in several topics.
    """
    try:
        import rosbags  # noqa: F401
    except ImportError as error:
        raise package_error(f"source: {str(path)!r} is a rosbag2, which", "rosbags") from error
    bags = _bags(path)
    if len(bags) > _MAX_BAGS:
        raise ValueError(f"source: {str(path)!r} has {len(bags):,} bags, expected at most {_MAX_BAGS:,}")
    motions, read = [], 0
    for bag in bags:
        try:
            messages = _joint_messages(bag, MAX_NUMBERS - read)
        except Exception as error:  # rosbags', SQLite's, of YAML and of truncated messages
            line = " ".join(str(error).split())[:300]
            raise ValueError(f"source: the bag {str(bag)!r} cannot be read: {line}") from error
        read += sum(_size(message) for topic_messages in messages.values() for _, message in topic_messages)
        motions.append(_motion(str(bag), messages, joints, topic))
    return motions


def _joint_messages(bag: Path, limit: int) -> dict[str, list[tuple[int, Any]]]:
    """The messages with joint angles by topic, with the times at which they were recorded [ns]."""
    from rosbags.rosbag2 import Reader

    store, messages, read = _type_store(), {}, 0
    with Reader(check_folder(bag) if bag.is_dir() else check_file(bag, None)) as reader:
        connections = [connection for connection in reader.connections if connection.msgtype == _TYPE]
        for connection, recorded, content in reader.messages(connections) if connections else ():
            message = store.deserialize_cdr(content, _TYPE)
            read += _size(message)
            if read > limit:
                raise ValueError(f"expected at most {MAX_NUMBERS:,} numbers in all bags")
            if len(message.position) == len(message.name) > 0:
                messages.setdefault(connection.topic, []).append((recorded, message))
    return messages


def _size(message: Any) -> int:
    return _FLOATS_OF_JOINT * max(len(message.name), 1)


def _motion(bag: str, messages: Mapping[str, Sequence[tuple[int, Any]]], joints: Sequence[str], topic: str) -> Motion:
    """The motion of joints in the messages of a bag."""
    needed = set(joints)
    names = {  # of a message with all joints; of the one with the most where there is none
        name: max((message.name for _, message in rows), key=lambda present: (needed <= set(present), len(present)))
        for name, rows in messages.items()
    }
    rows = messages[choose_entry(bag, names, joints, topic, "topic")]
    rows = [row for row in rows if needed <= set(row[1].name)]
    columns = [[message.name.index(joint) for joint in joints] for _, message in rows]
    stamps = np.array([message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for _, message in rows])
    recorded = np.array([time for time, _ in rows])
    nanoseconds = stamps if np.all(stamps > 0) else recorded
    order = np.argsort(nanoseconds, kind="stable")
    time = (nanoseconds - nanoseconds.min())[order] / 1e9
    qpos = np.array([row[1].position[column] for row, column in zip(rows, columns, strict=True)])[order]
    if not all(len(message.velocity) == len(message.name) for _, message in rows):
        return Motion(time, qpos, None)
    qvel = np.array([row[1].velocity[column] for row, column in zip(rows, columns, strict=True)])[order]
    return Motion(time, qpos, qvel)
