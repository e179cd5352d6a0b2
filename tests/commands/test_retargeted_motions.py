"""The motions beside a data set of `mimic.retarget`."""

import numpy as np
import pytest

from mimic.arms.embodiment import panda, planar_arm
from mimic.commands.retargeted_motions import MOTIONS, read_motions, save_motions
from mimic.motions.formats.episodes import Motion

LENGTHS = {"first": 4, "second": 7}
BASE = [0.1, 0.2, 0.0, 0.5]


def motions(joints):
    return {
        name: Motion(0.1 * np.arange(length), np.random.default_rng(length).normal(size=(length, joints)), None)
        for name, length in LENGTHS.items()
    }


def test_motions_in_chain_lengths_have_no_base(tmp_path):
    save_motions(tmp_path, (panda(), panda()), motions(7), motions(7), None)
    assert read_motions(tmp_path).base is None


@pytest.fixture
def folder(tmp_path):
    save_motions(tmp_path, (panda(), planar_arm((0.3,) * 4)), motions(7), motions(4), BASE)
    return tmp_path


def test_an_episode_comes_back(folder):
    found = read_motions(folder)
    assert found.episodes == tuple(LENGTHS)
    assert found.joints == {"expert": panda().joint_names, "learner": planar_arm((0.3,) * 4).joint_names}
    assert found.base == BASE
    time, qpos, learner_qpos, objects = found.of_episode(1)
    assert objects.shape == (7, 0, 4, 4)
    np.testing.assert_array_equal(time, motions(7)["second"].time)
    np.testing.assert_array_equal(qpos, motions(7)["second"].qpos)
    np.testing.assert_array_equal(learner_qpos, motions(4)["second"].qpos)


def test_objects_come_back_where_all_episodes_have_the_same_number(tmp_path):
    arms, own = (panda(), planar_arm((0.3,) * 4)), motions(7)
    poses = {name: np.random.default_rng(0).normal(size=(length, 2, 4, 4)) for name, length in LENGTHS.items()}
    own = {name: motion._replace(objects=poses[name]) for name, motion in own.items()}
    save_motions(tmp_path, arms, own, motions(4), BASE)
    np.testing.assert_array_equal(read_motions(tmp_path).of_episode(1)[3], poses["second"])
    own["second"] = own["second"]._replace(objects=poses["second"][:, :1])
    save_motions(tmp_path, arms, own, motions(4), BASE)
    assert read_motions(tmp_path).objects.shape == (sum(LENGTHS.values()), 0, 4, 4)


def test_what_is_no_such_folder_is_one_line(tmp_path):
    with pytest.raises(ValueError, match="retargeted: expected a folder that mimic.retarget source=DATA wrote"):
        read_motions(tmp_path)


def test_a_truncated_file_is_one_line(folder):
    (folder / MOTIONS).write_bytes((folder / MOTIONS).read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"retargeted: '.*' is damaged: [^\n]*$"):
        read_motions(folder)


@pytest.mark.parametrize(
    "changes",
    [
        {"split_points": np.array(3)},
        {"split_points": np.array([0, 4, 10])},
        {"episodes": np.array("first")},
        {"time": np.full(11, np.nan)},
        {"time": np.arange(11, 0, -1.0)},
        {"base": np.zeros(3)},
        {"expert_qpos": np.full((11, 7), np.inf)},
        {"learner_joints": np.array(["a", "b"])},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_a_damaged_array_is_one_line(folder, changes):
    with np.load(folder / MOTIONS) as file:
        arrays = dict(file)
    np.savez(folder / MOTIONS, **arrays | changes)
    with pytest.raises(ValueError, match=r"retargeted: '.*' is damaged: [^\n]*$"):
        read_motions(folder)
