"""The picture of an expert's poses and the learner's closest poses."""

import dataclasses

import numpy as np
import pytest
from PIL import Image

from mimic.arms.arm import ArmConfig, build_arm
from mimic.commands.pose_picture import PANDA_POSES, nearest_poses, readable_poses, save_poses
from mimic.envs.config import EnvConfig
from mimic.metric.similarity import MEASURES

PLANAR = ArmConfig("planar", link_lengths=[0.5, 0.3, 0.2])


def test_poses_of_an_expert():
    panda = ArmConfig(locked=[2])
    poses = readable_poses(panda, build_arm(panda), np.zeros((20, 6)))
    np.testing.assert_array_equal(poses, np.delete(PANDA_POSES, 1, axis=1))
    lower, upper = np.asarray(build_arm(ArmConfig(), "hardware").embodiment.joint_range).T
    assert np.all((lower <= PANDA_POSES) & (upper >= PANDA_POSES))
    others = np.linspace(0, 1, 20)[:, None] * np.ones(3)
    chosen = readable_poses(PLANAR, build_arm(PLANAR), others)
    assert chosen.shape == (5, 3) and np.all(np.diff(chosen[:, 0]) > 0.15) and chosen[-1, 0] == 1


@pytest.fixture(scope="module")
def env():
    return EnvConfig(expert=PLANAR, learner=dataclasses.replace(PLANAR, locked=[3]))


def test_a_reachable_pose_is_reached(env, tmp_path):
    expert, learner = build_arm(env.expert), build_arm(env.learner)
    qpos = np.array([[0.5, -0.9, 0.0], [0.3, 0.8, 0.9]], np.float32)  # the locked joint is at 0 in the first alone
    pairs = nearest_poses(expert, learner, env.metric, qpos)
    np.testing.assert_allclose(pairs.learner_qpos[0], qpos[0, :2], atol=1e-3)  # float32, where the distance is flat
    assert pairs.distance[0] < 1e-3 < 0.05 < pairs.distance[1]
    assert pairs.similarity["centre_line_distance"][0] < 1e-3 < pairs.similarity["centre_line_distance"][1]
    entries = pairs.as_json()
    assert len(entries) == 2 and set(entries[0]) == {"expert_qpos", "learner_qpos", "distance", *MEASURES}
    save_poses(tmp_path / "poses.png", expert, learner, env, pairs)
    image = np.asarray(Image.open(tmp_path / "poses.png").convert("RGB"), float)
    assert image.std() > 10 and image.shape[0] == 759  # 6.9 in at 110 dots an inch
