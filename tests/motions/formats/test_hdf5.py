"""HDF5 files as robosuite, robomimic, ACT and DROID write them, and what is rejected."""

import json

import numpy as np
import pytest

import mimic
from mimic.motions.formats.hdf5 import is_hdf5, read_hdf5
from mimic.motions.importing import read_recording
from tests.helpers.real_data import ROBOSUITE, needs

h5py = pytest.importorskip("h5py")

JOINTS = ("joint1", "joint2")
COUNT = 40
TIME = np.arange(COUNT) / 20  # s
ANGLES = 0.5 * np.sin(TIME[:, None] + [0, 1])
SPEEDS = 0.5 * np.cos(TIME[:, None] + [0, 1])
FINGER = np.linspace(0, 0.04, COUNT)[:, None]
# An object's free joint comes first; the joints of a body come before those of its children, wherever they are written.
MODEL = """<mujoco><default><default class="finger"><joint type="slide"/></default></default><worldbody>
  <body><freejoint name="cube"/></body><body><joint name="lid" type="ball"/></body>
  <body><body><joint name="robot0_joint2"/><body><joint name="gripper0_finger" class="finger"/></body></body>
    <joint name="robot0_joint1"/></body></worldbody></mujoco>"""
STATES = np.hstack([TIME[:, None], np.zeros((COUNT, 11)), ANGLES, FINGER, np.zeros((COUNT, 9)), SPEEDS, 0 * FINGER])


def write(path, content, attributes=None):
    """A file with data sets by their paths, and attributes by the paths of groups."""
    with h5py.File(path, "w") as file:
        for name, values in content.items():
            file[name] = values
        for group, values in (attributes or {}).items():
            file.require_group(group).attrs.update(values)
    return path


def robosuite(path, **changes):
    content = {f"data/demo_{number}/states": STATES for number in (1, 2, 10)}
    models = {f"data/demo_{number}": {"model_file": MODEL} for number in (1, 2, 10)}
    return write(path, content | changes, models)


ROBOMIMIC = {
    "data/demo_0/actions": np.zeros((COUNT, 7)), "data/demo_0/obs/robot0_joint_pos": ANGLES,
    "data/demo_0/obs/robot0_joint_vel": SPEEDS, "data/demo_0/obs/robot0_joint_pos_cos": np.cos(ANGLES),
    "data/demo_0/obs/robot0_gripper_qpos": FINGER, "data/demo_0/obs/robot0_gripper_qvel": 0 * FINGER,
    "data/demo_0/next_obs/robot0_joint_pos": ANGLES + 1, "data/demo_0/next_obs/robot0_gripper_qpos": FINGER,
}  # fmt: skip
ACT = {"observations/qpos": np.hstack([ANGLES, FINGER]), "observations/qvel": np.hstack([SPEEDS, FINGER]),
       "action": np.zeros((COUNT, 3))}  # fmt: skip
DROID = {
    "observation/robot_state/joint_positions": ANGLES, "observation/robot_state/joint_velocities": SPEEDS,
    "observation/robot_state/gripper_position": FINGER[:, 0], "action/joint_position": ANGLES + 1,
    "observation/stamp_ms": 1000 * TIME,
}  # fmt: skip
ENVIRONMENT = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": 20}})


@pytest.mark.parametrize(
    ("content", "attributes", "rate", "names"),
    [
        (ROBOMIMIC, {"data": {"env_args": ENVIRONMENT}}, None, ["demo_0"]),
        (ACT, {}, 20.0, ["a"]),
        (ACT, {"observations": {}, "/": {"fps": 20}}, None, ["a"]),
        (DROID, {}, None, ["a"]),
    ],
)
def test_observed_joints_are_read_with_their_gripper(tmp_path, content, attributes, rate, names):
    recording = read_hdf5(write(tmp_path / "a.hdf5", content, attributes), JOINTS, rate=rate)
    assert list(recording.motions) == names
    (motion,) = recording.motions.values()
    np.testing.assert_array_equal(motion.qpos, ANGLES)
    np.testing.assert_array_equal(motion.qvel, SPEEDS)
    np.testing.assert_array_equal(motion.gripper, FINGER)
    np.testing.assert_allclose(motion.time, TIME, atol=1e-9)
    assert any("by their order" in line for line in recording.notes)


@pytest.mark.parametrize(
    ("content", "attributes", "rate", "stated"),
    [
        ({"demo_1/states": STATES}, {"demo_1": {"model_file": MODEL}}, 50.0, "states"),
        (DROID, {}, 50.0, "observation/stamp_ms"),
        (ACT, {"/": {"fps": 20}}, 50.0, "the attributes, 20"),
        (ACT, {"/": {"fps": 20}}, 20.0, ""),
        (ACT, {}, 50.0, ""),
    ],
)
def test_a_rate_in_place_of_stored_times_is_a_line(tmp_path, content, attributes, rate, stated):
    recording = read_hdf5(write(tmp_path / "a.hdf5", content, attributes), JOINTS, rate=rate)
    lines = [line for line in recording.notes if line.startswith("times: ")]
    assert lines == [f"times: {rate:g} samples a second, as rate= says, and not those of {stated}"] * bool(stated)


def test_states_are_read_in_the_order_of_the_model(tmp_path):
    recording = read_hdf5(robosuite(tmp_path / "demo.hdf5"), JOINTS)
    assert list(recording.motions) == ["demo_1", "demo_2", "demo_10"] and recording.gripper == ("gripper0_finger",)
    for motion in recording.motions.values():
        for values, expected in zip(motion[:4], (TIME, ANGLES, SPEEDS, FINGER), strict=True):
            np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("folder", [".", "models"])
def test_a_model_may_lie_beside_the_file_and_a_folder_has_episodes(folder, tmp_path):
    (tmp_path / folder).mkdir(exist_ok=True)
    (tmp_path / folder / "model.xml").write_text(MODEL)
    for name in ("episode_0", "episode_1"):
        file = write(
            tmp_path / f"{name}.h5", {"demo_3/states": STATES}, {"demo_3": {"model_file": "/home/x/model.xml"}}
        )
        assert is_hdf5(file)
    recording = read_hdf5(tmp_path, JOINTS)
    assert list(recording.motions) == ["episode_0 demo_3", "episode_1 demo_3"]
    np.testing.assert_array_equal(recording.motions["episode_1 demo_3"].qpos, ANGLES)


def test_two_arms_are_a_question_that_numbers_or_a_topic_answer(tmp_path):
    both = write(
        tmp_path / "a.h5", {"observations/qpos": np.hstack([ANGLES, FINGER, ANGLES + 1, FINGER])}, {"/": {"fps": 20}}
    )
    np.testing.assert_array_equal(read_hdf5(both, ["4", "5"]).motions["a"].qpos, ANGLES + 1)
    content = {"obs/robot0_joint_pos": ANGLES, "obs/robot1_joint_pos": ANGLES + 1,
               "obs/robot0_gripper_qpos": FINGER, "obs/robot1_gripper_qpos": -FINGER}  # fmt: skip
    two = write(tmp_path / "b.h5", content, {"/": {"fps": 20}})
    with pytest.raises(ValueError, match="expected one, as topic=obs/robot0_joint_pos or topic=obs/robot1_joint_pos"):
        read_hdf5(two, JOINTS)
    motion = read_hdf5(two, JOINTS, "obs/robot1_joint_pos").motions["b"]
    np.testing.assert_array_equal(motion.qpos, ANGLES + 1)
    np.testing.assert_array_equal(motion.gripper, -FINGER)


def test_an_empty_episode_is_left_out(tmp_path):
    content = {f"demo_{number}/qpos": ANGLES[: COUNT * (number != 1)] for number in range(3)}
    source = write(tmp_path / "a.h5", content, {"/": {"fps": 20}})
    recording = read_recording(source, mimic.planar_arm([1.0, 1.0]))
    assert [name.split()[0] for name in recording.motions] == ["demo_0", "demo_2"]
    assert any(line.startswith("left out: demo_1 in") for line in recording.notes)


@pytest.mark.parametrize(
    ("content", "attributes", "message"),
    [
        (
            {"demo_0/qpos": ANGLES, "demo_1/qpos": ANGLES[:, :1]},
            {"/": {"fps": 20}},
            "/demo_1 has 1 columns as qpos, expected 2",
        ),
        (
            {"demo_0/qpos": ANGLES, "demo_1/force": ANGLES},
            {"/": {"fps": 20}},
            "/demo_1 has 0 columns as qpos, expected 2",
        ),
        (ACT, {}, "states no times: .* expected rate=, samples per second"),
        ({"actions": ANGLES}, {}, "no data set with the joints joint1, joint2; its joint angles: none"),
        ({"text": np.array([b"a"])}, {}, "has no data sets of angles"),
        (
            {"demo_0/states": STATES[:, :20]},
            {"demo_0": {"model_file": MODEL}},
            "expected 27 columns for the model, got",
        ),
        ({"demo_0/states": STATES}, {"demo_0": {"model_file": "<!DOCTYPE a>" + MODEL}}, "declares a document type"),
        (
            {"demo_0/states": STATES},
            {"demo_0": {"model_file": MODEL[:99]}},
            "no element found|unclosed token|mismatched",
        ),
        ({"demo_0/states": STATES}, {"demo_0": {"model_file": "none.xml"}}, "No such file"),
        (
            {"demo_0/states": STATES},
            {"demo_0": {"model_file": f"<mujoco>{2000 * '<worldbody>'}{2000 * '</worldbody>'}</mujoco>"}},
            "has too many levels of XML or JSON",
        ),
        (
            {"demo_0/qpos": ANGLES, "demo_0/actions": ANGLES},
            {"/": {"fps": 20, "env_args": 20_000 * "[" + 20_000 * "]"}},
            "has too many levels of XML or JSON",
        ),
    ],
)
def test_files_that_cannot_be_read(tmp_path, content, attributes, message):
    with pytest.raises(ValueError, match=f"^source: .*({message})") as error:
        read_hdf5(write(tmp_path / "a.hdf5", content, attributes), JOINTS)
    assert "\n" not in str(error.value)


def test_damaged_files_and_links_out_of_a_file_are_rejected(tmp_path, monkeypatch):
    (tmp_path / "text.h5").write_text("?")
    robosuite(tmp_path / "cut.h5")
    (tmp_path / "cut.h5").write_bytes((tmp_path / "cut.h5").read_bytes()[:3000])
    for name in ("text.h5", "cut.h5"):
        with pytest.raises(ValueError, match="^source: ") as error:
            read_hdf5(tmp_path / name, JOINTS)
        assert "\n" not in str(error.value)
    write(tmp_path / "secret.h5", {"qpos": ANGLES})
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["qpos"] = h5py.ExternalLink("secret.h5", "qpos")
    with pytest.raises(ValueError, match="has no data sets of angles"):
        read_hdf5(tmp_path / "link.h5", JOINTS)
    layout = h5py.VirtualLayout(ANGLES.shape, float)
    layout[:] = h5py.VirtualSource(tmp_path / "secret.h5", "qpos", ANGLES.shape)
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        file.create_virtual_dataset("qpos", layout)
    with pytest.raises(ValueError, match="qpos is stored in another file"):
        read_hdf5(tmp_path / "virtual.h5", JOINTS)
    monkeypatch.setattr("mimic.motions.formats.hdf5.MAX_NUMBERS", 50)
    with pytest.raises(ValueError, match="expected at most 50"):
        read_hdf5(tmp_path / "secret.h5", JOINTS, rate=20)


@needs(ROBOSUITE)
@pytest.mark.parametrize("task", ["stack", "wipe"])
def test_demonstrations_of_robosuite_are_read(task):
    """Of a Panda, which is first in each state: time, seven angles, two fingers."""
    recording = read_recording(ROBOSUITE / task, mimic.panda())
    with h5py.File(ROBOSUITE / task / "demo.hdf5") as file:
        states = file["data/demo_1/states"][()]
    (motion,) = recording.motions.values()
    np.testing.assert_array_equal(motion.time, states[:, 0])
    np.testing.assert_array_equal(motion.qpos, states[:, 1:8])
    assert motion.qvel is not None and "20 samples a second; velocities: from the source" in recording.notes[0]
    if task == "wipe":
        assert recording.gripper == () and motion.gripper is None
    else:
        assert recording.gripper == ("gripper0_finger_joint1", "gripper0_finger_joint2")
        np.testing.assert_array_equal(motion.gripper, states[:, 8:10])
