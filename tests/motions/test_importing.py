"""Imported motions: tables and files of LocoMuJoCo become demonstrations or are rejected in one line."""

import sys

import numpy as np
import pytest

import mimic
from mimic.motions.formats.archives import read_archive
from mimic.motions.formats.hdf5 import read_hdf5
from mimic.motions.formats.lerobot_reading import read_lerobot
from mimic.motions.formats.rosbag2 import read_rosbag2
from tests.helpers.commands import run

TIME = np.arange(0, 6.0, 0.02)  # s
PHASE = np.arange(7)
NUMBERED = [f"q_{i}" for i in range(1, 8)]


def swing(time):
    """Angles and velocities of a Panda that swings."""
    time = np.asarray(time)[:, None]
    return 0.5 * np.sin(time + PHASE), 0.5 * np.cos(time + PHASE)


def write_csv(path, header, columns):
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=",".join(header), comments="", fmt="%.9g")
    return path


def table(path, *, names, velocity_names=(), time=TIME, factor=1.0):
    qpos, qvel = swing(time)
    return write_csv(
        path, ["time", *names, *velocity_names], [time, factor * qpos, *([qvel] if velocity_names else [])]
    )


def archive(path, **changes):
    """As LocoMuJoCo writes it: a free joint first, two motions one after the other."""
    qpos, qvel = swing(TIME)
    free = np.zeros((len(TIME), 7))
    content = {
        "qpos": np.tile(np.hstack([free, qpos]), (2, 1)).astype(np.float32),
        "qvel": np.tile(np.hstack([free[:, :6], qvel]), (2, 1)).astype(np.float32),
        "joint_names": np.array(["root", *(f"joint{i}" for i in range(1, 8))]),
        "jnt_type": np.array([0, *[3] * 7]),
        "njnt": np.array(8),
        "frequency": np.array([50.0]),
        "split_points": np.array([0, len(TIME), 2 * len(TIME)]),
        "metadata": np.array(None, object),  # pickled, which is not read
        **changes,
    }
    np.savez(path, **{key: value for key, value in content.items() if value is not None})
    return path


@pytest.mark.slow
def test_a_table_becomes_demonstrations_that_training_takes(tmp_path):
    source = table(tmp_path / "swing.csv", names=NUMBERED, velocity_names=[f"qdot_{i}" for i in range(1, 8)])
    out = tmp_path / "swing.npz"
    said = run("demonstrations", f"source={source}", f"out={out}")
    assert (
        "1 demonstrations, 50 steps of 0.1 s\n1 motion, 5.98 s, 50 samples a second; velocities: from the source"
        in said
    )
    assert {path.name for path in tmp_path.iterdir()} == {"swing.csv", "swing.npz", "swing.png"}
    loaded = mimic.load_demonstrations(out)
    qpos, qvel = swing(0.1 * np.arange(51))
    np.testing.assert_allclose(loaded.qpos[0], qpos, atol=1e-6)  # the error of a cubic spline over 0.1 s
    np.testing.assert_allclose(loaded.qvel[0], qvel, atol=1e-6)
    assert loaded.torque is None
    loaded.check_fits(mimic.panda(), 0.1, 50)


def test_velocities_are_differentiated_where_there_are_none(tmp_path):
    source = table(tmp_path / "swing.csv", names=[f"q_joint{i}" for i in range(1, 8)])
    loaded, notes = mimic.import_demonstrations(source, mimic.panda())
    assert "velocities: computed from the angles" in notes[0]
    _, qvel = swing(0.1 * np.arange(51))
    np.testing.assert_allclose(
        loaded.qvel[0, 1:], qvel[1:], atol=2e-4
    )  # a cubic over 0.1 s: 0.1^3 / 4 of the fourth derivative
    np.testing.assert_allclose(loaded.qvel[0, 0], qvel[0], atol=1e-3)


def test_steps_between_samples_are_cubic(tmp_path):
    """Samples at other times than the control steps, and not evenly: 4e-4, the error of a cubic over 0.17 s."""
    time = np.sort(np.concatenate([[0, 5.5], np.random.default_rng(0).uniform(0, 5.5, 120)]))
    source = table(tmp_path / "uneven.csv", names=[f"q_{i}" for i in range(1, 8)],
                   velocity_names=[f"qdot_{i}" for i in range(1, 8)], time=time)  # fmt: skip
    imported, notes = mimic.import_demonstrations(source, mimic.panda())
    assert "velocities: from the source" in notes[0]
    np.testing.assert_allclose(imported.qpos[0], swing(0.1 * np.arange(51))[0], atol=4e-4)


def test_a_table_may_hold_several_demonstrations(tmp_path):
    qpos, _ = swing(TIME)
    which = np.repeat([1.0, 2.0], len(TIME))
    header = ["demonstration", "t", *(f"joint{i}" for i in range(1, 8))]
    source = write_csv(tmp_path / "two.csv", header, [which, np.tile(TIME, 2), np.concatenate([qpos, 0.5 * qpos])])
    imported, notes = mimic.import_demonstrations(source, mimic.panda(), horizon=30)
    assert "windows of 3 s: 4, of 2 motions" in notes  # of 5.98 s: the second begins 2.98 s after the first
    assert imported.count == 4 and imported.horizon == 30
    np.testing.assert_allclose(imported.qpos[2:], 0.5 * imported.qpos[:2], atol=1e-8)


def test_locomujoco_files_are_split_and_their_free_joint_is_left_out(tmp_path):
    imported, notes = mimic.import_demonstrations(archive(tmp_path / "loco.npz"), mimic.panda())
    assert imported.count == 2 and "velocities: from the source" in notes[0]
    qpos, qvel = swing(0.1 * np.arange(51))
    for which in range(2):
        np.testing.assert_allclose(imported.qpos[which], qpos, atol=1e-6)  # float32
        np.testing.assert_allclose(imported.qvel[which], qvel, atol=1e-5)


def test_samples_that_are_no_numbers_are_left_out_of_an_archive(tmp_path):
    qpos = np.tile(swing(TIME)[0], (2, 1))
    qpos[100] = np.nan
    names = np.array([f"joint{i}" for i in range(1, 8)])
    source = archive(tmp_path / "loco.npz", qpos=qpos, qvel=None, joint_names=names, jnt_type=None)
    source = source.rename(tmp_path / "LOCO.NPZ")
    imported, notes = mimic.import_demonstrations(source, mimic.panda())
    assert imported.count == 2 and any("without numbers left out: 1 of 300 in motion 0" in line for line in notes)


def test_angles_beyond_the_range_of_the_model_are_a_warning(tmp_path):
    """Such as degrees of a small motion, which limits=none takes."""
    source, ranges = table(tmp_path / "swing.csv", names=NUMBERED), np.tile([-0.2, 0.2], (7, 1))
    _, notes = mimic.import_demonstrations(source, mimic.panda(), joint_range=ranges)
    assert any("rad beyond the range of the expert's model: another arm, other units" in line for line in notes)


@pytest.mark.parametrize(("shape", "kind"), [((600, 6), "float64"), ((600, 3), "<U3")])
def test_an_array_of_no_single_hand_is_noted(tmp_path, shape, kind):
    """Such as of two hands, or text: the joints are read nevertheless."""
    source = archive(tmp_path / "loco.npz", hand_pos=np.zeros(shape, kind))
    recording = read_archive(source, mimic.panda().joint_names)
    assert f"hand_pos: expected numbers [600, 3], got {kind} {list(shape)}: not used" in recording.notes
    assert all(motion.hand is None for motion in recording.motions.values())


def test_joint_names_of_the_file_can_be_given(tmp_path):
    names = [f"panda_{i}" for i in "abcdefg"]
    source = archive(tmp_path / "loco.npz", joint_names=np.array(["root", *names]))
    imported, _ = mimic.import_demonstrations(source, mimic.panda(), joints=names)
    assert imported.joint_names == mimic.panda().joint_names


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (None, [], "no file at"),
        (lambda path: table(path, names=NUMBERED[:6] + ["q_9"]), [], "has no table with the joints joint1"),
        (lambda path: table(path, names=NUMBERED, factor=57.3), [], "12.5664]; degrees need units=deg"),
        (lambda path: table(path, names=NUMBERED, time=TIME[:100]), [], "lasts 1.98 s, but an episode 5 s"),
        (lambda path: table(path, names=NUMBERED, factor=16.0, time=TIME), ["limits=none"], "has a velocity of"),
        (lambda path: table(path, names=NUMBERED), ["joints=[a]"], "joints: expected 7 different names"),
        (lambda path: table(path, names=NUMBERED), ["joints=[1,2,3,4,5,6,6]"], "got 7, 6 of them different"),
        (lambda path: table(path, names=NUMBERED), ["joints=[1,2,3,4,5,6,wrist]"], "names in the source, as 1, 2, 3, "
         "4, 5, 6, 7, got 'wrist'"),
    ],
)  # fmt: skip
def test_bad_tables(reason, tmp_path, make, arguments, message):
    path = tmp_path / "motion.csv"
    if make:
        make(path)
    assert message in reason("demonstrations", f"source={path}", "out=new.npz", *arguments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint_names": np.array(list("abcdefgh"))}, "has no array with the joints joint1, joint2"),
        ({"frequency": None}, "lacks frequency; expected qpos, joint_names, frequency or dt"),
        ({"frequency": np.array(0.0)}, "frequency or dt in"),
        ({"qpos": np.zeros(3)}, "qpos in"),
        ({"jnt_type": None}, "qpos in"),
        ({"split_points": np.array([0, 10])}, "must increase from 0 to 600"),
    ],
)
def test_bad_archives(reason, tmp_path, changes, message):
    path = archive(tmp_path / "motion.npz", **changes)
    assert message in reason("demonstrations", f"source={path}", "out=new.npz")


@pytest.mark.parametrize(
    ("package", "read"), [("h5py", read_hdf5), ("pyarrow", read_lerobot), ("rosbags", read_rosbag2)]
)
def test_a_missing_package_is_named(package, read, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ValueError, match=rf"needs the package {package}: pip install 'mimic-arms\[datasets\]'"):
        read(tmp_path, NUMBERED)
