"""LeRobot datasets: what is written is what the format requires."""

import json

import numpy as np
import pytest

from mimic.motions.formats import lerobot
from mimic.motions.formats.episodes import ANGLE
from mimic.motions.formats.lerobot import frames_per_second, write_lerobot
from mimic.motions.formats.lerobot_reading import read_lerobot
from tests.helpers.episodes import COUNT, DT, EXPERT, LEARNER, STEPS, episodes, motions

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")


@pytest.fixture
def written(tmp_path):
    write_lerobot(tmp_path, episodes())
    return tmp_path


def data(folder):
    return pa.concat_tables([pq.read_table(file) for file in sorted((folder / "data").glob("*/*.parquet"))])


def values(table, name):
    return np.array(table[name].to_pylist())


def test_the_files_are_those_of_version_3(written):
    assert {str(path.relative_to(written)) for path in written.rglob("*") if path.is_file()} == {
        "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/mimic.json",
        "meta/episodes/chunk-000/file-000.parquet", "data/chunk-000/file-000.parquet",
    }  # fmt: skip
    info = json.loads((written / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 10, "arm")
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 16, 1)
    assert info["splits"] == {"train": "0:2", "held_out": "2:3"}
    file = info["data_path"].format(chunk_index=0, file_index=0)
    assert (written / file).is_file()


def test_features_have_the_shapes_names_and_units_of_the_data(written):
    features = json.loads((written / "meta/info.json").read_text())["features"]
    table = data(written)
    assert list(features) == table.column_names
    for name, feature in features.items():
        column = values(table, name).reshape(table.num_rows, -1)
        assert [column.shape[1]] == feature["shape"]
        kind = table.schema.field(name).type
        number = kind.value_type if column.shape[1] > 1 else kind
        assert str(number) == {"float32": "float", "int64": "int64"}[feature["dtype"]]
        assert all(len(feature[key]) == column.shape[1] for key in ("names", "units") if feature.get(key))
    assert features["observation.state"]["names"] == ["joint1.pos", "joint2.pos", "joint1.vel", "joint2.vel"]
    assert features["observation.state"]["units"] == ["rad", "rad", "rad/s", "rad/s"]
    assert features["observation.environment_state"]["names"][2] == "expert.joint3.pos"
    assert features["action"]["names"] == ["joint1.torque", "joint2.torque"]
    assert features["action"]["units"] == ["N m"] * 2


def test_frames_are_the_samples_before_each_command(written):
    source, table = episodes(), data(written)
    for episode, steps in enumerate(source.steps):
        rows = table.filter(pa.compute.equal(table["episode_index"], episode))
        assert values(rows, "frame_index").tolist() == list(range(steps))
        assert set(values(rows, "task_index")) == {0}
        np.testing.assert_allclose(values(rows, "timestamp"), DT * np.arange(steps), atol=1e-6)  # float32
        for name, arm in (("observation.state", source.robot), ("observation.environment_state", source.expert)):
            expected = np.hstack([arm.qpos[episode, :steps], arm.qvel[episode, :steps]]).astype(np.float32)
            np.testing.assert_array_equal(values(rows, name), expected)
        np.testing.assert_array_equal(values(rows, "action"), source.robot.command[episode, :steps].astype(np.float32))
    assert values(table, "index").tolist() == list(range(16))


def test_episodes_tell_where_they_are_and_how_they_end(written):
    source, table = episodes(), pq.read_table(written / "meta/episodes/chunk-000/file-000.parquet")
    start, end, length = (values(table, name) for name in ("dataset_from_index", "dataset_to_index", "length"))
    assert start[0] == 0 and end[-1] == data(written).num_rows
    assert (start[1:] == end[:-1]).all() and (end - start == length).all() and length.tolist() == source.steps
    assert table["tasks"].to_pylist() == [["imitate"]] * 3
    assert table["split"].to_pylist() == ["train", "train", "held_out"]
    assert table["demonstration"].to_pylist() == [0, 1, 0]
    for episode, steps in enumerate(source.steps):
        expected = np.append(source.robot.qpos[episode, steps], source.robot.qvel[episode, steps])
        np.testing.assert_array_equal(values(table, "final/observation.state")[episode], expected.astype(np.float32))


def test_statistics_are_those_of_numpy(written):
    stats, table = json.loads((written / "meta/stats.json").read_text()), data(written)
    rows = pq.read_table(written / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    parts = [("", slice(None), stats)]
    parts += [("stats/{}/{}", slice(row["dataset_from_index"], row["dataset_to_index"]), row) for row in rows]
    functions = {"min": np.min, "max": np.max, "mean": np.mean, "std": np.std}
    functions |= {f"q{q:02d}": lambda x, axis, q=q: np.percentile(x, q, axis=axis) for q in (1, 10, 50, 90, 99)}
    for form, part, content in parts:
        for name in table.column_names:
            column = values(table, name).reshape(table.num_rows, -1)[part]
            found = {
                key: content[form.format(name, key)] if form else content[name][key] for key in (*functions, "count")
            }
            assert found.pop("count") == [len(column)]
            for key, function in functions.items():
                np.testing.assert_allclose(found[key], function(column, axis=0), rtol=1e-12, atol=1e-12)  # in double


def test_the_task_is_the_index_of_its_table(written):
    """LeRobot looks tasks up in the index of a pandas frame."""
    table = pq.read_table(written / "meta/tasks.parquet")
    assert table.to_pylist() == [{"task_index": 0, "task": "imitate"}]
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_without_commands_the_action_is_the_next_pose(tmp_path):
    robot = motions(LEARNER, 0, commands=False)
    write_lerobot(tmp_path, episodes(robot=robot, expert=False, steps=(6, 6, 6)))
    action = values(data(tmp_path), "action").reshape(COUNT, STEPS, 2)
    np.testing.assert_array_equal(action, robot.qpos[:, 1:].astype(np.float32))
    info = json.loads((tmp_path / "meta/info.json").read_text())
    assert info["features"]["action"]["names"] == [f"joint1.{ANGLE.name}", f"joint2.{ANGLE.name}"]
    assert "observation.environment_state" not in info["features"]
    assert "no command is known" in json.loads((tmp_path / "meta/mimic.json").read_text())["meaning"]["action"]


def test_one_joint_has_scalar_actions(tmp_path):
    write_lerobot(tmp_path, episodes(robot=motions(("joint1",), 0), expert=False))
    assert str(data(tmp_path).schema.field("action").type) == "float"
    assert read_lerobot(tmp_path, ["joint1"]).motions["episode 0"].qpos.shape == (STEPS + 1, 1)


def test_large_datasets_have_several_files(tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot, "FILE_BYTES", 300)  # two or three episodes
    write_lerobot(tmp_path, episodes())
    files = sorted((tmp_path / "data").glob("*/*.parquet"))
    assert [file.name for file in files] == [f"file-{number:03d}.parquet" for number in range(3)]
    rows = pq.read_table(tmp_path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for row in rows:
        table = pq.read_table(files[row["data/file_index"]])
        assert set(table["episode_index"].to_pylist()) == {row["episode_index"]}
    assert len(read_lerobot(tmp_path, EXPERT).motions) == 3


@pytest.mark.parametrize("dt", [0.03, 2.0, 0.0999])
def test_a_rate_that_is_no_whole_number_is_rejected(dt):
    assert frames_per_second(0.05) == 20
    with pytest.raises(ValueError, match="format=lerobot: expected a time step of 1/N s, .* format=rosbag2 takes any"):
        frames_per_second(dt)
