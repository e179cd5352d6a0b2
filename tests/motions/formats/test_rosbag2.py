"""rosbag2: the library of others reads typed messages of what is written, and bags of others are read."""

import sqlite3
from typing import Any

import numpy as np
import pytest

from mimic.motions.formats.rosbag2 import is_rosbag2, read_rosbag2, write_rosbag2
from tests.helpers.episodes import COUNT, DT, EXPERT, LEARNER, STEPS, episodes, motions

rosbags = pytest.importorskip("rosbags")
from rosbags.highlevel import AnyReader  # noqa: E402
from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

TYPE = "sensor_msgs/msg/JointState"
SECOND = 10**9  # ns
STORE = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture
def written(tmp_path):
    write_rosbag2(tmp_path / "bags", episodes())
    return tmp_path / "bags"


def messages(bag) -> list[tuple[str, int, Any]]:
    """Topic, time [ns] and message of each, with the types that the bag itself defines."""
    with AnyReader([bag], default_typestore=STORE) as reader:
        return [(c.topic, time, reader.deserialize(raw, c.msgtype)) for c, time, raw in reader.messages()]


def of_topic(rows, topic):
    return [message for name, _, message in rows if name == topic]


def test_each_episode_is_a_bag_of_typed_messages(written):
    source = episodes()
    assert sorted(path.name for path in written.iterdir()) == [f"episode_{index:06d}" for index in range(COUNT)]
    for episode, steps in enumerate(source.steps):
        rows = messages(written / f"episode_{episode:06d}")
        assert {message.__msgtype__ for _, _, message in rows} == {TYPE}
        assert {topic for topic, _, _ in rows} == {
            *("/expert/joint_states", "/expert/joint_commands"),
            *("/learner/joint_states", "/learner/joint_commands"),
        }  # fmt: skip
        for topic, arm in (("/expert/joint_states", source.expert), ("/learner/joint_states", source.robot)):
            states = of_topic(rows, topic)
            assert {tuple(message.name) for message in states} == {arm.joint_names}
            np.testing.assert_array_equal([m.position for m in states], arm.qpos[episode, : steps + 1])
            np.testing.assert_array_equal([m.velocity for m in states], arm.qvel[episode, : steps + 1])
            assert all(len(message.effort) == 0 for message in states)
            commands = of_topic(rows, topic.replace("states", "commands"))
            np.testing.assert_array_equal([m.effort for m in commands], arm.command[episode, :steps])
            assert all(len(message.position) == len(message.velocity) == 0 for message in commands)


def test_stamps_are_the_times_of_the_samples(written):
    """From 1 s, since ROS takes a stamp of 0 as none."""
    rows = messages(written / "episode_000000")
    stamps = [message.header.stamp.sec * SECOND + message.header.stamp.nanosec for _, _, message in rows]
    assert stamps == [time for _, time, _ in rows] == sorted(stamps)
    states = [stamp for stamp, row in zip(stamps, rows, strict=True) if row[0] == "/learner/joint_states"]
    assert states == [SECOND + round(DT * sample * SECOND) for sample in range(STEPS + 1)]


def test_the_metadata_tell_what_a_bag_is(written):
    from ruamel.yaml import YAML

    content = YAML(typ="safe").load((written / "episode_000002/metadata.yaml").read_text())
    information = content["rosbag2_bagfile_information"]
    assert information["message_count"] == 4 * STEPS + 2 and information["storage_identifier"] == "sqlite3"
    assert information["duration"]["nanoseconds"] == round(STEPS * DT * SECOND)
    custom = information["custom_data"]
    assert custom["units"] == "position rad, velocity rad/s, effort N m"
    assert (custom["task"], custom["split"], custom["demonstration"]) == ("imitate", "held_out", "0")


def test_one_arm_has_the_topics_that_ros_expects(tmp_path):
    write_rosbag2(tmp_path / "bags", episodes(robot=motions(LEARNER, 0, commands=False), expert=False))
    assert {topic for topic, _, _ in messages(tmp_path / "bags/episode_000000")} == {"/joint_states"}


@pytest.mark.parametrize(("joints", "topic"), [(EXPERT, ""), (LEARNER, "/learner/joint_states")])
def test_what_was_written_is_read(written, joints, topic):
    assert is_rosbag2(written) and is_rosbag2(written / "episode_000000") and not is_rosbag2(written.parent)
    source = episodes()
    arm = source.robot if topic else source.expert
    for episode, motion in enumerate(read_rosbag2(written, joints, topic).motions.values()):
        steps = source.steps[episode]
        np.testing.assert_allclose(motion.time, DT * np.arange(steps + 1), atol=1e-9)  # whole nanoseconds
        np.testing.assert_array_equal(motion.qpos, arm.qpos[episode, : steps + 1])
        np.testing.assert_array_equal(motion.qvel, arm.qvel[episode, : steps + 1])


def driver(
    path,
    *,
    names=("b", "a"),
    stamp=lambda i: 1.7e9 + i / 100,
    speed=1.0,
    twice=False,
    velocity=True,
    plugin=StoragePlugin.SQLITE3,
):
    """A bag as a driver records it: 2 s of a swing at 100 Hz, and each tenth time a message of the gripper alone."""
    types = STORE.types
    header, time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        note = types["std_msgs/msg/String"]("of another topic")
        text = writer.add_connection("/rosout", note.__msgtype__, typestore=STORE)
        writer.write(text, SECOND, STORE.serialize_cdr(note, note.__msgtype__))
        states = writer.add_connection("/joint_states", TYPE, typestore=STORE)
        for i in range(200):
            now = round(stamp(i) * SECOND)
            head, recorded = header(time(now // SECOND, now % SECOND), ""), round((1.7e9 + i / 100 / speed) * SECOND)
            angle, rate = 0.5 * np.sin(i / 50), np.array([0, np.cos(i / 50)] if velocity else [])
            arm = types[TYPE](head, list(names), np.array([0, angle]), rate, np.full(2, np.nan))
            gripper = types[TYPE](head, ["finger"], np.array([0.01 * i]), np.zeros(1), np.zeros(1))
            for copy in range(1 + twice):
                writer.write(states, recorded + copy, STORE.serialize_cdr(arm, TYPE))
            if i % 10 == 0:
                writer.write(states, recorded + 5, STORE.serialize_cdr(gripper, TYPE))
    return path


SAMPLES = 0.01 * np.arange(200)  # s
ABOUT_TIMES = "times: when messages were recorded, since their headers state none that increase"


@pytest.mark.parametrize(
    ("settings", "notes"),
    [
        ({}, ()),
        ({"stamp": lambda i: i / 100, "speed": 0.5}, ()),  # a simulation's clock, which is half as fast as the real one
        ({"stamp": lambda i: 0}, (ABOUT_TIMES,)),
        ({"stamp": lambda i: 1.7e9 + i // 100}, (ABOUT_TIMES,)),  # whole seconds
        ({"twice": True}, ()),
        ({"velocity": False, "plugin": StoragePlugin.MCAP}, ()),
    ],
)
def test_bags_of_drivers_and_simulations(tmp_path, settings, notes):
    recording = read_rosbag2(driver(tmp_path / "bag", **settings), ["a", "b"])
    motion = recording.motions["bag"].take(slice(None, None, 1 + settings.get("twice", False)))
    np.testing.assert_allclose(motion.time, SAMPLES, atol=1e-6)  # of 1.7e9 s in double precision
    np.testing.assert_allclose(motion.qpos[:, 0], 0.5 * np.sin(2 * SAMPLES))
    if settings.get("velocity", True):
        np.testing.assert_allclose(motion.qvel[:, 0], np.cos(2 * SAMPLES))
    else:
        assert motion.qvel is None
    assert recording.notes == notes and recording.gripper == ("finger",) and motion.gripper is not None
    np.testing.assert_allclose(motion.gripper[:191, 0], SAMPLES[:191], atol=1e-6)  # between messages linear


def test_a_clock_that_starts_anew_starts_a_new_motion(tmp_path):
    motion = read_rosbag2(driver(tmp_path / "bag", stamp=lambda i: (i % 100) / 100), ["a"]).motions["bag"]
    np.testing.assert_allclose(motion.time, np.tile(SAMPLES[:100], 2))  # as recorded; `cleaned` splits it


def test_a_single_file_is_a_bag(tmp_path):
    (file,) = driver(tmp_path / "bag", plugin=StoragePlugin.MCAP).glob("*.mcap")
    assert is_rosbag2(file)
    np.testing.assert_allclose(read_rosbag2(file, ["a"]).motions[file.name].qpos[:, 0], 0.5 * np.sin(2 * SAMPLES))


def test_bags_without_the_joints(tmp_path):
    message = r"has no topic with the joints a, b; its joint angles: /joint_states \(a, c, finger\)"
    with pytest.raises(ValueError, match=message):
        read_rosbag2(driver(tmp_path / "bag", names=("a", "c")), ["a", "b"])


def test_several_topics_with_the_joints_are_a_question(tmp_path):
    write_rosbag2(tmp_path / "bags", episodes(robot=motions(EXPERT, 0)))
    with pytest.raises(ValueError, match="topic=/expert/joint_states or topic=/learner/joint_states"):
        read_rosbag2(tmp_path / "bags", EXPERT)
    with pytest.raises(ValueError, match=r"topic: expected a topic .*; got '/learner/joint_commands'"):
        read_rosbag2(tmp_path / "bags", EXPERT, "/learner/joint_commands")


def damage_messages(path):
    with sqlite3.connect(path) as database:
        database.execute("update messages set data = x'00010000ffffffff'")


DAMAGES = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "text": lambda path: path.write_text("{?"),
    "missing": lambda path: path.unlink(),
    "messages": damage_messages,
}


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        ("metadata.yaml", "text"),
        *(("episode_000001.db3", damage) for damage in ("truncated", "missing", "messages")),
    ],
)
def test_damaged_bags_are_rejected(written, file, damage):
    DAMAGES[damage](written / "episode_000001" / file)
    with pytest.raises(ValueError, match=r"^source: the bag .*episode_000001' cannot be read: ") as error:
        read_rosbag2(written, EXPERT)
    assert "\n" not in str(error.value)


def test_sizes_are_bounded(written, monkeypatch):
    monkeypatch.setattr("mimic.motions.formats.rosbag2.MAX_NUMBERS", 50)
    with pytest.raises(ValueError, match="expected at most 50 numbers in all bags"):
        read_rosbag2(written, EXPERT)
