"""Data sets written again for another arm: read back, its motions are the same, and so is all that is not the arm's."""

import dataclasses
import json
import re

import numpy as np
import pytest

import mimic
from mimic.motions.demonstrations import Demonstrations, load_demonstrations
from mimic.motions.evidence import _of_hand_steps, hand_points, samples_of
from mimic.motions.formats.episodes import Motion
from mimic.motions.formats.replacing import replaced_columns
from mimic.motions.importing import read_source
from mimic.motions.rewriting import read_data_set, write_data_set
from tests.helpers.corruptions import write
from tests.helpers.real_data import ROBOSUITE, needs

EXPERT = dataclasses.replace(mimic.planar_arm([0.3, 0.3, 0.2]), joint_range=np.array([[-2.0, 2.0]] * 3))
LEARNER = dataclasses.replace(
    mimic.planar_arm([0.4, 0.3, 0.2, 0.1]), name="learner", joint_names=("l1", "l2", "l3", "l4")
)
RATE, COUNTS = 20, (60, 50, 70)
OLD, NEW = EXPERT.joint_names, LEARNER.joint_names
RANGES = np.array([[-1.0, 3.0]] * 4)  # rad, of the learner's joints


def expert_motion(count):
    time = np.arange(count) / RATE
    return time, 0.5 * np.sin(time[:, None] + np.arange(3))


def rewrite(tmp_path, source, kept=None, **options):
    """Writes a source again with made-up motions of the learner; returns the data set, these, the folder and lines."""
    data = read_data_set(source, EXPERT, **options)
    motions = {}
    for shift, (entry, found) in enumerate(data.motions.items()):
        motions[entry] = {}
        for name, motion in found.items():
            qpos = 0.3 + 0.1 * shift + np.c_[0.5 * motion.qpos, motion.qpos[:, :1] ** 2]
            motions[entry][name] = Motion(motion.time, qpos, np.gradient(qpos, motion.time, axis=0), motion.gripper)
    out = tmp_path / "out"
    out.mkdir()
    kept = list(data.measured) if kept is None else [list(data.measured)[index] for index in kept]
    return data, motions, out, write_data_set(data, out, LEARNER, motions, kept, RANGES)


# --- columns ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "old", "expected"),
    [
        (["x", "a.pos", "b.pos", "a.vel", "b.vel", "jaw.pos"], ["a", "b"],
         ["x", "l1.pos", "l2.pos", "l3.pos", "l1.vel", "l2.vel", "l3.vel", "jaw.pos"]),
        (["time", "q_1", "q_2", "dq_1", "dq_2"], ["1", "2"], ["time", "q_1", "q_2", "q_3", "dq_1", "dq_2", "dq_3"]),
        (["actual_q_0", "actual_q_1"], ["actual 0", "actual 1"], ["actual_q_0", "actual_q_1", "actual_q_2"]),
        (["/js/joint1/position", "/js/joint2/position"], ["/js/joint1", "/js/joint2"], ["l1/position"]),
        ([*map(str, range(1, 13))], ["1", "2"], [*map(str, [1, 2, 3, *range(3, 13)])]),
        (["a [deg]", "b [deg]", "tau_a", "tau_b"], ["a", "b"], ["l1 [deg]", "l2 [deg]", "l3 [deg]"]),
        (["q_d_a", "q_d_b", "q_a", "q_b", "b_cmd"], ["a", "b"], ["q_l1", "q_l2", "q_l3"]),
        (["target_q_0", "target_q_1", "actual_q_0", "actual_q_1", "target_q_7"], ["actual 0", "actual 1"],
         ["actual_q_0", "actual_q_1", "actual_q_2", "target_q_7"]),
        (["joint1", "joint2", "finger_joint1"], ["joint1", "joint2"], ["l1", "l2", "l3", "finger_joint1"]),
    ],
)  # fmt: skip
def test_columns_are_called_as_those_before(names, old, expected):
    columns, dropped = replaced_columns(names, old, ["l1", "l2", "l3"])
    found = [column.name for column in columns]
    assert found[: len(expected)] == expected
    assert dropped == [name for name in names if re.search("tau|_d_|_cmd|target_q_[01]", name)]


# --- LeRobot ----------------------------------------------------------------------------------------------------------


def lerobot(root, version):
    """A data set in degrees with an action that leads, a gripper, a reward, a video file and statistics."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    episodes = []
    for episode, count in enumerate(COUNTS):
        time, qpos = expert_motion(count)
        rewards, opening = np.arange(count) + 100.0 * episode, 50 + 40 * np.sin(3 * time)[:, None]
        angles = {"qpos": np.degrees(qpos), "action": np.degrees(qpos + 0.02), "gripper": opening}
        episodes.append({"time": time, **angles, "next.reward": rewards})
    write(root, version, episodes)
    info = json.loads((root / "meta/info.json").read_text())
    state = info["features"]["observation.state"]
    state["names"] = {"motors": state["names"]}
    info["features"]["observation.images.front"] = {"dtype": "video", "shape": [4, 4, 3], "names": ["h", "w", "c"]}
    info |= {"robot_type": "old", "splits": {"train": "0:2", "test": "2:3"}, "total_videos": 3}
    speeds = [f"{name}.vel" for name in (*OLD, "gripper")]
    info["features"]["observation.velocity"] = {"dtype": "float32", "shape": [4], "names": speeds}
    (root / "meta/info.json").write_text(json.dumps(info))
    for file in (root / "data").rglob("*.parquet"):
        table = pq.ParquetFile(file).read()
        pq.write_table(table.append_column("observation.velocity", table["action"]), file)
    if version.startswith("v2"):
        (root / "videos/chunk-000/front").mkdir(parents=True)
        for episode in range(3):
            (root / f"videos/chunk-000/front/episode_{episode:06d}.mp4").write_bytes(b"video %d" % episode)
        rows = [{"episode_index": k, "tasks": ["t"], "length": count} for k, count in enumerate(COUNTS)]
        (root / "meta/episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        of_episode = {"action": {"mean": [0.0] * 4}, "observation.velocity": {}, "next.reward": {"mean": [7.0]}}
        stats = [{"episode_index": k, "stats": of_episode} for k in range(3)]
        (root / "meta/episodes_stats.jsonl").write_text("".join(json.dumps(row) + "\n" for row in stats))
    else:
        folder = root / "meta/episodes/chunk-000"
        folder.mkdir(parents=True)
        ends = np.cumsum(COUNTS)
        pq.write_table(pa.table({
            "episode_index": np.arange(3), "length": COUNTS, "dataset_from_index": ends - COUNTS,
            "dataset_to_index": ends, "stats/action/mean": [[0.0] * 4] * 3,
            "stats/observation.velocity/mean": [[0.0] * 4] * 3,
            "videos/observation.images.front/from_timestamp": [0.0, 3.0, 5.5],
        }), folder / "file-000.parquet")  # fmt: skip
        (root / "meta/stats.json").write_text(
            json.dumps({"action": {"mean": [0.0] * 4}, "observation.velocity": {}, "next.reward": {"mean": [7.0]}})
        )
    return root


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_lerobot_dataset(tmp_path, version):
    import pyarrow.parquet as pq

    source = lerobot(tmp_path / "in", version)
    data, motions, out, lines = rewrite(tmp_path, source, kept=[0, 2], units="deg")
    assert (data.entry, data.commands, data.unit) == ("observation.state", ("action",), "deg")
    assert lines == ["left out, as not known of learner: observation.velocity"]
    assert not [file for file in out.rglob("*") if file.is_file() and b"observation.velocity" in file.read_bytes()]
    info = json.loads((out / "meta/info.json").read_text())
    assert info["robot_type"] == LEARNER.name
    assert (info["total_episodes"], info["total_frames"]) == (2, COUNTS[0] + COUNTS[2])
    assert info["splits"] == {"train": "0:1", "test": "1:2"}
    assert info["features"]["observation.state"]["names"] == {"motors": [f"{name}.pos" for name in (*NEW, "gripper")]}
    assert info["features"]["action"]["shape"] == [5]
    for entry in ("observation.state", "action"):
        back = read_source(out, NEW, entry, None).motions
        for name, old in (("episode 0", "episode 0"), ("episode 1", "episode 2")):
            np.testing.assert_allclose(np.radians(back[name].qpos), motions[entry][old].qpos, atol=1e-5)
            np.testing.assert_allclose(back[name].gripper, data.measured[old].gripper, atol=1e-4)
    table = pq.ParquetFile(sorted(out.glob("data/*/*.parquet"))[-1]).read()
    rewards = table["next.reward"].to_numpy()
    assert rewards[-1] == 200 + COUNTS[2] - 1  # other columns are carried over
    assert table["index"].to_numpy()[-1] == COUNTS[0] + COUNTS[2] - 1
    whole = np.degrees(np.concatenate([motions["action"][name].qpos for name in ("episode 0", "episode 2")]))
    if version == "v2.1":
        assert (out / "videos/chunk-000/front/episode_000001.mp4").read_bytes() == b"video 2"
        assert not (out / "videos/chunk-000/front/episode_000002.mp4").exists()
        rows = [json.loads(line) for line in (out / "meta/episodes_stats.jsonl").read_text().splitlines()]
        np.testing.assert_allclose(rows[0]["stats"]["action"]["mean"][:4], whole[: COUNTS[0]].mean(axis=0), atol=1e-3)
        assert rows[1]["stats"]["next.reward"] == {"mean": [7.0]}
        assert [json.loads(line)["length"] for line in (out / "meta/episodes.jsonl").read_text().splitlines()] == [
            60,
            70,
        ]
    else:
        stats = json.loads((out / "meta/stats.json").read_text())
        np.testing.assert_allclose(stats["action"]["mean"][:4], whole.mean(axis=0), atol=1e-3)
        assert stats["next.reward"] == {"mean": [7.0]}
        episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
        assert episodes["dataset_from_index"] == [0, COUNTS[0]]
        assert episodes["videos/observation.images.front/from_timestamp"] == [0.0, 5.5]
        np.testing.assert_allclose(episodes["stats/action/mean"][1][:4], whole[COUNTS[0] :].mean(axis=0), atol=1e-3)


def test_actions_without_names_that_are_no_angles_are_carried_over(tmp_path):
    """Such as steps of the hand, with as many numbers as the arm has joints and gripper."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    source = lerobot(tmp_path / "in", "v3.0")
    info = json.loads((source / "meta/info.json").read_text())
    for feature in ("observation.state", "action"):
        info["features"][feature]["names"] = None
    (source / "meta/info.json").write_text(json.dumps(info))
    (file,) = (source / "data").rglob("*.parquet")
    table, steps = pq.ParquetFile(file).read(), np.random.default_rng(0).uniform(-1, 1, (sum(COUNTS), 4))
    place = table.column_names.index("action")
    pq.write_table(table.set_column(place, "action", pa.array(steps.tolist(), table.schema.field("action").type)), file)
    data, _, out, _ = rewrite(tmp_path, source, units="deg")
    assert data.commands == ()
    assert "action: as in the source, since its numbers are not near the measured angles" in data.notes
    (file,) = (out / "data").rglob("*.parquet")
    np.testing.assert_allclose(pq.ParquetFile(file).read()["action"].to_pylist(), steps, atol=1e-6)  # float32


# --- HDF5 -------------------------------------------------------------------------------------------------------------


def test_a_robomimic_file(tmp_path):
    h5py = pytest.importorskip("h5py")
    source = tmp_path / "low_dim.hdf5"
    with h5py.File(source, "w") as file:
        file.create_group("data").attrs["total"] = sum(COUNTS)
        file["data"].attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": RATE}})
        for episode, count in enumerate(COUNTS):
            _, qpos = expert_motion(count)
            demo = file.create_group(f"data/demo_{episode}")
            demo.attrs["num_samples"] = count
            demo["obs/robot0_joint_pos"], demo["obs/robot0_joint_pos_cos"] = qpos, np.cos(qpos)
            demo["obs/robot0_joint_vel"] = np.gradient(qpos, 1 / RATE, axis=0)
            demo["next_obs/robot0_joint_pos"] = np.concatenate([qpos[1:], qpos[-1:]])
            demo["obs/robot0_gripper_qpos"], demo["rewards"] = qpos[:, :2] / 50, np.arange(count)
            demo["obs/image"] = np.zeros((count, 2, 2, 3), np.uint8) + episode
        file["mask/train"] = np.array([b"demo_0", b"demo_1"])
    _, motions, out, lines = rewrite(tmp_path, source, kept=[1, 2])
    assert any("next_obs/robot0_joint_pos: the last one" in line for line in lines)
    back = read_source(out / "low_dim.hdf5", NEW, "obs/robot0_joint_pos", None)
    assert list(back.motions) == ["demo_1", "demo_2"]
    for name, motion in back.motions.items():
        (expected,) = (found[name] for found in motions.values())
        np.testing.assert_allclose(motion.qpos, expected.qpos, atol=1e-12)
        np.testing.assert_allclose(motion.qvel, expected.qvel, atol=1e-12)
        np.testing.assert_allclose(motion.gripper, expected.gripper)
    with h5py.File(out / "low_dim.hdf5") as file:
        demo = file["data/demo_2"]
        np.testing.assert_allclose(demo["obs/robot0_joint_pos_cos"], np.cos(demo["obs/robot0_joint_pos"]))
        np.testing.assert_allclose(demo["next_obs/robot0_joint_pos"][:-1], demo["obs/robot0_joint_pos"][1:])
        assert demo["obs/image"][0, 0, 0, 0] == 2
        assert demo["rewards"][5] == 5
        assert list(file["mask/train"]) == [b"demo_1"]
        assert file["data"].attrs["total"] == COUNTS[1] + COUNTS[2]


def test_commanded_angles_of_an_act_file(tmp_path):
    h5py = pytest.importorskip("h5py")
    time, qpos = expert_motion(60)
    with h5py.File(tmp_path / "act.hdf5", "w") as file:
        file.attrs["fps"] = RATE
        file["observations/qpos"], file["observations/effort"], file["action"] = qpos, 9 * qpos, qpos + 0.05
        file["leader_action"] = np.cos(30 * time)[:, None] * np.ones(3)
    data, motions, out, lines = rewrite(tmp_path, tmp_path / "act.hdf5")
    assert data.commands == ("action",)
    assert "as in the source, since nothing tells what they command: leader_action" in lines
    assert "left out, as not known of learner: observations/effort" in lines
    with h5py.File(out / "act.hdf5") as file:
        np.testing.assert_allclose(file["action"], motions["action"]["act"].qpos)
        np.testing.assert_allclose(file["leader_action"][:, 0], np.cos(30 * time))
        assert "effort" not in file["observations"]


# --- tables and npz ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("controller", "turns"), [
    ({"type": "OSC_POSE", "input_type": "delta", "input_ref_frame": "base"}, True),
    ({"type": "OSC_POSE", "control_delta": True}, False),  # in the axes of the world
    ({"type": "JOINT_POSITION", "input_type": "delta", "input_ref_frame": "base"}, False),
])  # fmt: skip
def test_commanded_steps_of_the_hand_are_in_the_axes_of_the_learners_base(tmp_path, controller, turns):
    h5py = pytest.importorskip("h5py")
    (tmp_path / "in").mkdir()
    with h5py.File(source := tmp_path / "in/demo.hdf5", "w") as file:
        env = {"env_kwargs": {"control_freq": RATE, "controller_configs": {"body_parts": {"right": controller}}}}
        file.create_group("data").attrs["env_args"] = json.dumps(env)
        time, qpos = expert_motion(40)
        file["data/demo_0/obs/robot0_joint_pos"] = qpos
        steps = np.random.default_rng(0).normal(size=(40, 7))
        file["data/demo_0/actions"] = steps
    data = read_data_set(source, EXPERT)
    motion = Motion(time, np.c_[qpos, qpos[:, 0]], np.c_[qpos, qpos[:, 0]])
    write_data_set(data, tmp_path, LEARNER, {data.entry: {"demo_0": motion}}, ["demo_0"], RANGES, yaw=0.5)
    with h5py.File(tmp_path / "demo.hdf5") as file:
        written = file["data/demo_0/actions"][()]
    turn = np.array([[np.cos(0.5), -np.sin(0.5), 0], [np.sin(0.5), np.cos(0.5), 0], [0, 0, 1]]) if turns else np.eye(3)
    np.testing.assert_allclose(written[:, :3] @ turn.T, steps[:, :3], atol=1e-12)
    np.testing.assert_allclose(written[:, 3:6] @ turn.T, steps[:, 3:6], atol=1e-12)
    np.testing.assert_array_equal(written[:, 6], steps[:, 6])


@pytest.mark.parametrize("case", ["presses", "is led along one axis"])
def test_a_hand_fits_its_commanded_steps_and_another_arm_does_not(case):
    """Commands along z press on a table; or the hand is led along y and trembles along the others."""
    arm, time = mimic.panda(), np.arange(200) / RATE
    if case == "presses":
        motion, negated = 0.3 * np.sin(time[:, None] * np.linspace(0.7, 1.9, 7)), 1
    else:
        tremor = 1e-4 * np.random.default_rng(0).normal(size=(200, 7))
        motion, negated = tremor + 0.1 * np.sin(time[:, None]) * np.eye(7)[0], 0
    qpos = np.array(arm.home) + motion
    samples, (hand, _) = samples_of({"a": Motion(time, qpos, None)}), hand_points(arm, qpos)
    steps = np.vstack([np.diff(hand, axis=0), np.zeros((1, 3))])
    if case == "presses":
        steps[0] = 0
        steps[:, 2] = 2 * np.abs(steps).max() * np.where(np.arange(len(steps)) % 9 < 4, 1, -1)
    else:
        steps[:, [0, 2]] = 0
    evidence = _of_hand_steps(arm, samples, np.roll(steps, -1, axis=0))
    other = evidence.rows * (1 - 2 * np.eye(7)[negated])
    right, wrong = evidence.errors(np.stack([evidence.rows, other]))[:, 0]
    assert right < evidence.tolerance / 2
    assert wrong > evidence.tolerance


@needs(ROBOSUITE)
def test_a_recorded_hand_that_wipes_a_table_has_no_warning():
    pytest.importorskip("h5py")
    data = read_data_set(ROBOSUITE / "wipe/demo.hdf5", mimic.panda())
    assert not [note for note in data.notes if note.startswith("warning")]


@pytest.mark.parametrize(("separator", "decimal"), [(";", "."), (";", ","), (",", ".")])
def test_a_table(tmp_path, separator, decimal):
    def number(value):
        return f"{value:.6f}".replace(".", decimal)

    header = ["note", "time", *(f"{name} [deg]" for name in OLD), "jaw", "demonstration"]
    lines = ["# of a robot", separator.join(header)]
    for episode, count in enumerate(COUNTS):
        for time, angles in zip(*expert_motion(count), strict=True):
            lines.append(
                separator.join(
                    [f'"held{separator} firmly"', number(time), *map(number, np.degrees(angles)), "0", str(episode)]
                )
            )
    source = tmp_path / "motions.csv"
    source.write_text("\n".join(lines) + "\n")
    _, motions, out, _ = rewrite(tmp_path, source, kept=[0, 2])
    written = (out / "motions.csv").read_text().splitlines()
    assert written[0] == "# of a robot"
    assert written[1].split(separator) == ["note", "time", *(f"{name} [deg]" for name in NEW), "jaw", "demonstration"]
    assert written[2].startswith(f'"held{separator} firmly"{separator}{number(0)}{separator}')
    assert written[2].split(separator)[-2:] == ["0", "0"] and (decimal == "." or "." not in written[2])
    back = read_source(out / "motions.csv", NEW, "", None)
    assert back.unit == "deg"
    for name, motion in back.motions.items():
        (expected,) = (found[name] for found in motions.values())
        np.testing.assert_allclose(np.radians(motion.qpos), expected.qpos, atol=1e-7)
    assert list(back.motions) == ["demonstration 0", "demonstration 2"]


def test_an_npz_file(tmp_path):
    qpos = np.concatenate([expert_motion(count)[1] for count in COUNTS])
    base = np.arange(len(qpos))[:, None] * np.ones(7)
    np.savez(tmp_path / "m.npz", qpos=np.c_[base, qpos, base[:, :1]], joint_names=["root", *OLD, "lift"], dt=1 / RATE,
             jnt_type=[0, 3, 3, 3, 2], split_points=np.cumsum([0, *COUNTS]), label="kept")  # fmt: skip
    _, motions, out, _ = rewrite(tmp_path, tmp_path / "m.npz", kept=[1])
    back = read_source(out / "m.npz", NEW, "", None)
    (motion,), (expected,) = back.motions.values(), (found["motion 1"] for found in motions.values())
    np.testing.assert_allclose(motion.qpos, expected.qpos)
    with np.load(out / "m.npz") as content:
        assert content["joint_names"].tolist() == ["root", *NEW, "lift"]
        assert content["jnt_type"].tolist() == [0, 3, 3, 3, 3, 2]
        assert content["qpos"][0, 0] == COUNTS[0]
        assert content["label"] == "kept"


@pytest.mark.parametrize("has_gripper", [False, True])
def test_demonstrations_are_read_as_they_are(tmp_path, has_gripper):
    """Also with angles beyond the arm's range and with jumps."""
    qpos = np.random.default_rng(0).normal(scale=5, size=(2, 8, 3))
    channels = {"gripper": qpos[..., :1], "gripper_names": ("jaw",)} if has_gripper else {}
    Demonstrations(qpos, 0.1 * qpos, qpos[:, -1], 0.05, EXPERT.name, OLD, **channels).save(tmp_path / "in.npz")
    data, motions, out, lines = rewrite(tmp_path, tmp_path / "in.npz", kept=[1])
    for number, motion in enumerate(data.measured.values()):
        np.testing.assert_array_equal(motion.qpos, qpos[number])
        np.testing.assert_allclose(motion.time, 0.05 * np.arange(8))
    assert not data.faults and not data.notes and not lines
    written = load_demonstrations(out / "in.npz")
    assert (written.arm, written.joint_names, written.dt, written.count) == ("learner", NEW, 0.05, 1)
    np.testing.assert_array_equal(written.qpos[0], motions["qpos"]["motion 1"].qpos)
    np.testing.assert_array_equal(written.qvel[0], motions["qpos"]["motion 1"].qvel)
    assert (written.gripper is not None) == has_gripper and written.gripper_names == data.gripper


@pytest.mark.parametrize("kind", ["csv", "npz", "hdf5", "v2.1", "v3.0"])
def test_an_episode_that_needs_repair_is_left_out_with_all_its_samples(tmp_path, kind):
    pytest.importorskip("h5py"), pytest.importorskip("pyarrow")
    episodes = []
    for episode, count in enumerate(COUNTS):
        time, qpos = expert_motion(count)
        qpos[time > 1] += episode == 0  # rad, a jump
        hand = np.stack([time, time, episode + time], axis=1)
        speeds = np.gradient(qpos, time, axis=0)
        episodes.append({"time": time, "qpos": qpos, "qvel": speeds, "action": qpos, "hand": hand})
    source = write(tmp_path, kind, episodes)
    data, motions, out, _ = rewrite(tmp_path, source)
    assert ["jumps" in fault for fault in data.faults.values()] == [True]
    back = read_source(out / source.name if source.is_file() else out, NEW, "", None).motions
    assert len(back) == len(motions[data.entry]) == 2
    for motion, expected, episode in zip(back.values(), motions[data.entry].values(), episodes[1:], strict=True):
        np.testing.assert_allclose(motion.qpos, expected.qpos, atol=1e-6)  # float32
        np.testing.assert_allclose(motion.hand, episode["hand"], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state * np.nan, "no number as angle of joint1, joint2, joint3"),
        (lambda state: state[:, :3], "expected .* numbers or more in a frame"),
        (lambda state: state[:, :2], "numbers"),
    ],
)
def test_columns_of_a_data_set_that_are_no_angles_are_an_error(tmp_path, change, message):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    lerobot(tmp_path / "set", "v3.0")
    (file,) = (tmp_path / "set/data").rglob("*.parquet")
    table = pq.read_table(file)
    state = change(np.array(table["observation.state"].to_pylist()))
    column = pa.array(state.tolist(), pa.list_(pa.float32()))
    pq.write_table(
        table.set_column(table.schema.get_field_index("observation.state"), "observation.state", column), file
    )
    with pytest.raises(ValueError, match=message):
        read_data_set(tmp_path / "set", EXPERT, units="deg")
