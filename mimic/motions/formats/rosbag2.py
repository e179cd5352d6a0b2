"""Reads and writes joint motions as rosbag2, the recordings of ROS 2: https://github.com/ros2/rosbag2.

Messages are sensor_msgs/JointState, in rad, rad/s and N m. A bag is one motion; a dataset is a folder of bags.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mimic.base.distribution import import_extra
from mimic.base.files import check_file, check_folder
from mimic.motions.formats.episodes import (
    ANGLE,
    EXTRA,
    MAX_NUMBERS,
    TORQUE,
    VELOCITY,
    ArmMotions,
    Episodes,
    Motion,
    Recording,
)
from mimic.motions.formats.names import Selection, select

METADATA, BAG = "metadata.yaml", "episode_{:06d}"
BAG_FILES = (".db3", ".mcap")  # a bag that is one file
START = 10**9  # ns, the time of the first sample: a stamp of 0 means none in ROS
_TYPE = "sensor_msgs/msg/JointState"
_STATES, _COMMANDS = "joint_states", "joint_commands"
_VERSION = 8  # of the format: that of ROS 2 Iron and Jazzy
_FIELD = {ANGLE: "position", VELOCITY: "velocity", TORQUE: "effort"}  # of a message, for each kind of command
_MAX_BAGS = 100_000
_FLOATS_OF_JOINT = 3  # in a message
_DISTINCT = 0.3  # least fraction of stamps that differ, of those of a clock: some messages are published twice
_RESET = 5 * 10**8  # ns, a step back of a clock that starts anew; messages of several publishers arrive late by less


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
        topic: (names, fields, writer.add_connection(topic, _TYPE, typestore=store))
        for topic, names, fields in _topics(episodes, index)
    }
    none = np.zeros(0)
    for sample in range(episodes.steps[index] + 1):
        stamp = START + round(sample * episodes.dt * 1e9)
        for names, fields, connection in topics.values():
            values = {field: array[sample] for field, array in fields.items() if sample < len(array)}
            if not values:
                continue  # no command after the last step
            message = joint_state(
                header(time(stamp // 10**9, stamp % 10**9), frame_id=""),
                name=names,
                **{field: values.get(field, none) for field in _FIELD.values()},
            )
            writer.write(connection, stamp, store.serialize_cdr(message, _TYPE))


def _topics(episodes: Episodes, index: int) -> Iterator[tuple[str, list[str], dict[str, np.ndarray]]]:
    """Topics of an episode with the names of their joints and the values of each field [samples, joints]."""
    arms = {"": episodes.robot}
    if episodes.expert is not None:
        arms = {"/expert": episodes.expert, "/learner": episodes.robot}
    steps = episodes.steps[index]
    for prefix, motions in arms.items():
        states = {field: _floats(array[: steps + 1]) for field, array in _states(motions, index).items()}
        yield f"{prefix}/{_STATES}", [*motions.joint_names, *motions.gripper_names], states
        if motions.command is not None:
            commands = {_FIELD[motions.quantity]: _floats(motions.command[index][:steps])}
            yield f"{prefix}/{_COMMANDS}", list(motions.joint_names), commands


def _states(motions: ArmMotions, index: int) -> dict[str, np.ndarray]:
    """Positions and velocities of the joints and then the gripper, whose velocities are not known."""
    if motions.gripper is None:
        return {"position": motions.qpos[index], "velocity": motions.qvel[index]}
    gripper = motions.gripper[index]
    return {
        "position": np.concatenate([motions.qpos[index], gripper], axis=1),
        "velocity": np.concatenate([motions.qvel[index], np.full_like(gripper, np.nan)], axis=1),
    }


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
    return path.suffix.lower() in BAG_FILES if path.is_file() else bool(_bags(path))


def _bags(path: Path) -> list[Path]:
    if path.is_file() or (path / METADATA).is_file():
        return [path]
    return sorted(child.parent for child in path.glob(f"*/{METADATA}")) if path.is_dir() else []


def read_rosbag2(path: Path, joints: Sequence[str], topic: str = "") -> Recording:
    """The motions of joints, one for each bag. Needs rosbags.

    Times are those of the messages' headers, or when the messages were recorded where headers have none. A message
    without all joints is left out.

    Args:
      path: a bag, or a folder of bags.
      joints: names of the joints, base to tip.
      topic: topic of sensor_msgs/JointState that has them; empty for the only one that does.

    Raises:
      ValueError: a bag that cannot be read, or that lacks the joints or has them in several topics.
    """
    import_extra("rosbags", EXTRA, f"source: {str(path)!r} is a rosbag2, which")
    bags = _bags(path)
    if len(bags) > _MAX_BAGS:
        raise ValueError(f"source: {str(path)!r} has {len(bags):,} bags, expected at most {_MAX_BAGS:,}")
    motions, notes, gripper, read = {}, {}, [], 0
    for bag in bags:
        try:
            messages = _joint_messages(bag, MAX_NUMBERS - read)
        except Exception as error:  # rosbags', SQLite's, of YAML and of truncated messages
            line = " ".join(str(error).split())[:300]
            raise ValueError(f"source: the bag {str(bag)!r} cannot be read: {line}") from error
        read += sum(_size(message) for topic_messages in messages.values() for _, message in topic_messages)
        selection = _selection(str(bag), messages, joints, topic)
        motions[bag.name], lines = _motion(messages[selection.entry], selection)
        gripper = gripper or selection.gripper
        if selection.gripper != gripper:
            raise ValueError(f"source: {str(bag)!r} has the gripper {selection.gripper}, the bags before it {gripper}")
        notes |= dict.fromkeys([*selection.notes, *lines])
    return Recording(motions, tuple(gripper), notes=tuple(notes))


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


def _selection(
    bag: str, messages: Mapping[str, Sequence[tuple[int, Any]]], joints: Sequence[str], topic: str
) -> Selection:
    """The topic of the joints in a bag, and their names: those of any message of the topic."""
    names = {
        name: list(dict.fromkeys(present for _, message in rows for present in message.name))
        for name, rows in messages.items()
    }
    return select(bag, names, joints, topic, "topic")


def _motion(rows: Sequence[tuple[int, Any]], selection: Selection) -> tuple[Motion, list[str]]:
    """The motion of joints in the messages of a topic, and what was assumed about its times."""
    complete = [row for row in rows if set(selection.joints) <= set(row[1].name)]
    if not complete:
        raise ValueError(f"source: no message of {selection.entry} has all of the joints {', '.join(selection.joints)}")
    nanoseconds, notes = _times(complete)
    order = np.argsort(nanoseconds, kind="stable")
    if np.any(np.diff(nanoseconds) < -_RESET):
        order = np.arange(len(order))  # a clock that starts anew: `cleaned` begins a new motion there
    qpos, qvel = (_values(complete, field, selection.joints) for field in ("position", "velocity"))
    assert qpos is not None  # `_joint_messages` keeps messages with angles alone
    motion = Motion((nanoseconds - nanoseconds.min()) / 1e9, qpos, qvel).take(order)
    if not selection.gripper:
        return motion, notes
    with_gripper = [row for row in rows if set(selection.gripper) <= set(row[1].name)]  # often messages of their own
    if not with_gripper:
        return motion, [*notes, f"gripper: no message has all of {', '.join(selection.gripper)}"]
    times = (_times(with_gripper)[0] - nanoseconds.min()) / 1e9
    values, order = _values(with_gripper, "position", selection.gripper), np.argsort(times, kind="stable")
    assert values is not None
    channels = [np.interp(motion.time, times[order], channel[order]) for channel in values.T]
    return motion._replace(gripper=np.stack(channels, axis=1)), notes


def _times(rows: Sequence[tuple[int, Any]]) -> tuple[np.ndarray, list[str]]:
    """The times of messages [ns]: their stamps, unless no clock has set them, and notes.

    A simulation's clock begins at 0 s, so that a stamp of 0 alone says nothing; stamps that stand still do.
    """
    stamps = np.array([message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for _, message in rows])
    recorded = np.array([time for time, _ in rows])
    if 1 < len(np.unique(stamps)) >= _DISTINCT * len(np.unique(recorded)):
        return stamps, []
    return recorded, ["times: when messages were recorded, since their headers state none that increase"]


def _values(rows: Sequence[tuple[int, Any]], field: str, names: Sequence[str]) -> np.ndarray | None:
    """The values of joints [messages, joints] in a field of messages; None where a message has none."""
    if not all(len(getattr(message, field)) == len(message.name) for _, message in rows):
        return None
    return np.array([getattr(message, field)[[message.name.index(name) for name in names]] for _, message in rows])
