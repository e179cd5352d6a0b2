"""LeRobot datasets as a source of motions: mimic's own, those of others, and damaged ones."""

import json

import numpy as np
import pytest

from mimic.motions.formats.lerobot import write_lerobot
from mimic.motions.formats.lerobot_reading import is_lerobot, read_lerobot
from mimic.motions.importing import read_source
from tests.helpers.episodes import DT, EXPERT, LEARNER, STEPS, episodes, motions

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")


@pytest.fixture
def written(tmp_path):
    write_lerobot(tmp_path, episodes())
    return tmp_path


@pytest.mark.parametrize(("joints", "feature"), [(EXPERT, ""), (LEARNER, "observation.state")])
def test_what_was_written_is_read(written, joints, feature):
    assert is_lerobot(written) and not is_lerobot(written / "meta")
    source = episodes()
    arm = source.robot if feature else source.expert
    for episode, motion in enumerate(read_lerobot(written, joints, feature).motions.values()):
        steps = source.steps[episode]
        np.testing.assert_allclose(motion.time, DT * np.arange(steps + 1), atol=1e-12)  # exact multiples
        np.testing.assert_array_equal(motion.qpos, arm.qpos[episode, : steps + 1].astype(np.float32))
        np.testing.assert_array_equal(motion.qvel, arm.qvel[episode, : steps + 1].astype(np.float32))


def foreign(folder, *, names, version="v3.0", fps=20, units=None, **columns):
    """A dataset as others have it: without statistics and episodes, rows in any order, lists of any size."""
    rows = 2 * STEPS
    state = np.arange(rows * 2, dtype=np.float32).reshape(rows, 2)
    content = {
        "observation.state": state.tolist(),
        "episode_index": np.repeat([4, 7], STEPS),
        "frame_index": np.tile(np.arange(STEPS), 2),
        "timestamp": (np.tile(np.arange(STEPS), 2) / 20).astype(np.float32),
        **columns,
    }
    form = {"dtype": "float32", "shape": [2], "names": names, "units": units}
    info = {"codebase_version": version, "fps": fps, "features": {"observation.state": form}}
    (folder / "meta").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    table = pa.table(content).take(np.random.default_rng(0).permutation(rows))
    pq.write_table(table, folder / "data/chunk-000/file-000.parquet")
    return folder, state.reshape(2, STEPS, 2)


@pytest.mark.parametrize(
    "names", [["b", "a"], ["b.pos", "a.pos"], {"motors": ["b", "a"]}, [["b", "a"]], {"b": 0, "a": 1}]
)
def test_datasets_of_others_are_read(tmp_path, names):
    folder, state = foreign(tmp_path / "set", names=names)
    first, second = read_lerobot(folder, ["a", "b"]).motions.values()
    np.testing.assert_array_equal(first.qpos, state[0][:, ::-1])
    np.testing.assert_array_equal(second.qpos, state[1][:, ::-1])
    np.testing.assert_allclose(second.time, np.arange(STEPS) / 20, atol=1e-12)  # exact multiples
    assert first.qvel is None


def test_a_rate_without_effect_is_rejected(written):
    with pytest.raises(ValueError, match="rate: expected only for tables and HDF5 files"):
        read_source(written, EXPERT, "", 10.0)


def test_datasets_of_version_2_have_a_file_for_each_episode(tmp_path):
    """Without names of the columns: the joints in their order, then the gripper."""
    folder, state = foreign(tmp_path / "set", names=None, version="v2.1")
    (file,) = (folder / "data/chunk-000").iterdir()
    table = pq.read_table(file)
    for episode in (4, 7):
        rows = table.filter(pa.compute.equal(table["episode_index"], episode))
        pq.write_table(rows, file.with_name(f"episode_{episode:06d}.parquet"))
    file.unlink()
    recording = read_lerobot(folder, ["elbow"])
    assert list(recording.motions) == ["episode 4", "episode 7"] and recording.gripper == ("2",)
    np.testing.assert_array_equal(recording.motions["episode 7"].qpos, state[1][:, :1])
    np.testing.assert_array_equal(recording.motions["episode 7"].gripper, state[1][:, 1:])
    assert recording.notes == (
        "joints: 1, found by their order; joints=[...] names others",
        "gripper: 2, after the joints",
    )


def test_recorded_times_are_kept(tmp_path):
    recorded = np.tile(np.arange(STEPS) ** 1.1, 2).astype(np.float32)
    folder, _ = foreign(tmp_path / "set", names=["a", "b"], timestamp=recorded)
    np.testing.assert_array_equal(read_lerobot(folder, ["a", "b"]).motions["episode 4"].time, recorded[:STEPS])


NULLS = [None, *[[0.0, 0.0]] * (2 * STEPS - 1)]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"version": "v1.6"}, r"expected codebase_version v2.0 to v3.0, got 'v1.6'; LeRobot converts older datasets"),
        ({"fps": 0}, r"expected frames per second in .* got 0"),
        ({"names": ["a"]}, r"has no feature with the joints a, b; its joint angles: none"),
        ({"names": ["a", "c"]}, r"its joint angles: observation.state \(a, c\); joints=\[...\] names"),
        ({"units": ["deg", "rad"]}, "has a in 'deg', b in 'rad'; expected all angles in rad, in deg"),
        ({"observation.state": NULLS}, "expected numbers, got missing values"),
        ({"observation.state": [["x", "y"]] * 2 * STEPS}, "expected numbers, got string"),
        ({"observation.state": [[1.0], *[[0.0, 0.0]] * (2 * STEPS - 1)]}, "expected lists of one length, got 1 to 2"),
    ],
)
def test_datasets_that_cannot_be_read(tmp_path, settings, message):
    folder, _ = foreign(tmp_path / "set", **{"names": ["a", "b"], **settings})
    with pytest.raises(ValueError, match=message) as error:
        read_lerobot(folder, ["a", "b"])
    assert "\n" not in str(error.value)


DAMAGES = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "text": lambda path: path.write_text("?"),
    "missing": lambda path: path.unlink(),
}


DATA, ROWS = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        *((DATA, damage) for damage in DAMAGES),
        ("meta/info.json", "text"),
        (ROWS, "truncated"),
    ],
)
def test_damaged_files_are_rejected(written, file, damage):
    DAMAGES[damage](written / file)
    with pytest.raises(ValueError, match=r"^source: ") as error:
        read_lerobot(written, EXPERT)
    assert "\n" not in str(error.value)


def test_sizes_are_checked_before_anything_is_read(written, monkeypatch):
    monkeypatch.setattr("mimic.motions.formats.lerobot_reading.MAX_NUMBERS", 16 * (3 + 6) - 1)
    with pytest.raises(ValueError, match="expected 1 to 143 numbers, got 144"):
        read_lerobot(written, EXPERT)


def test_several_features_with_the_joints_are_a_question(tmp_path):
    write_lerobot(tmp_path, episodes(robot=motions(EXPERT, 0)))
    with pytest.raises(ValueError, match=r"topic=observation.state or topic=observation.environment_state"):
        read_lerobot(tmp_path, EXPERT)
    with pytest.raises(ValueError, match=r"topic: expected a feature .*; got 'observation.image'"):
        read_lerobot(tmp_path, EXPERT, "observation.image")
    assert len(read_lerobot(tmp_path, EXPERT, "observation.state").motions) == 3
