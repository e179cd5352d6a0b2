"""What was driven, as a LeRobot data set of the follower."""

import json

import numpy as np
import pytest

import mimic
from mimic.motions.formats.lerobot_reading import read_lerobot

RATE = 50.0


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """A recorder with two episodes, its commands, its samples, and the folder that it wrote."""
    leader, follower = mimic.panda(limits="hardware"), mimic.panda(limits="hardware", locked=[3])
    operator = mimic.Teleoperator(leader, follower, hand="relative", rate=RATE, grippers=((0, 1), (0.0, 0.08)))
    recorder, commands, samples = mimic.TeleoperationRecorder(operator), [], []
    with pytest.raises(ValueError, match="expected an episode, got no tick"):
        recorder.write(tmp_path_factory.mktemp("none") / "set")
    for ticks in (30, 20):
        recorder.step(leader.home)  # the clutch is open
        operator.engage()
        recorder.step(None)  # nothing leads yet
        for tick in range(ticks):
            samples.append(leader.home + 0.2 * np.sin(0.1 * tick))
            commands.append(recorder.step(samples[-1], gripper=None if tick < 5 else 1.0))
        operator.disengage()
    folder = tmp_path_factory.mktemp("driven") / "set"
    recorder.write(folder, task="wave")
    return recorder, commands, samples, folder


def test_episodes_are_between_clutches(driven):
    recorder, commands, _, folder = driven
    info = json.loads((folder / "meta/info.json").read_text())
    assert (recorder.episodes, info["total_episodes"], info["total_frames"], info["fps"]) == (2, 2, 50, RATE)
    assert len(commands) == 50
    with pytest.raises(ValueError, match="folder"):
        recorder.write(folder)


def test_actions_are_the_commands_and_states_the_poses_before(driven):
    recorder, commands, _, folder = driven
    names = recorder.operator.follower.joint_names
    actions = read_lerobot(folder, names, "action").motions
    states = read_lerobot(folder, names, "observation.state").motions
    path = np.array([command.qpos for command in commands])
    openings = np.array([np.nan if command.gripper is None else command.gripper for command in commands])
    for action, state, begin, end in zip(actions.values(), states.values(), (0, 30), (30, 50), strict=True):
        np.testing.assert_allclose(action.qpos[: end - begin], path[begin:end], atol=1e-6)  # of single precision
        np.testing.assert_allclose(state.qpos[1:], path[begin:end], atol=1e-6)
        moved = np.diff(state.qpos, axis=0) * RATE
        np.testing.assert_allclose(state.qvel[1:-1], (moved[1:] + moved[:-1]) / 2, atol=1e-4)
        np.testing.assert_allclose(action.gripper[5 : end - begin, 0], openings[begin + 5 : end], atol=1e-6)
        assert np.all(np.isfinite(action.gripper))  # before the leader's gripper is known, the first that is


def test_leader_is_beside_the_follower(driven):
    recorder, _, samples, folder = driven
    names = ["expert." + name for name in recorder.operator.leader.joint_names]
    motion = next(iter(read_lerobot(folder, names, "observation.environment_state").motions.values()))
    np.testing.assert_allclose(motion.qpos[:30], samples[:30], atol=1e-6)
