"""A learner whose hand follows the expert's in a live view, and an expert whose hand is dragged."""

import dataclasses
import importlib.util

import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.link_match import hand_poses
from mimic.commands import view
from mimic.commands.config import ViewConfig
from mimic.envs import env_config
from mimic.motions.formats.lerobot_reading import read_lerobot
from mimic.retargeting.teleoperation import TeleoperationStatus
from mimic.viewer.hand_following import HandDrag, HandFollower, HandFrame, HandSettings
from mimic.viewer.live_session import LiveSession
from tests.helpers import original_model
from tests.helpers.commands import free_port

TICK = 1 / 30
HOME = np.array([0, -0.8, 0, -2.4, 0, 1.6, 0.8], np.float32)
if importlib.util.find_spec("ruckig") is None:
    pytest.skip("needs ruckig", allow_module_level=True)


@pytest.fixture(scope="module")
def panda():
    return build_arm(ArmConfig(), "hardware").embodiment


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    file = original_model.ur_file(tmp_path_factory.mktemp("arm"))
    return dataclasses.replace(env_config("pair"), learner=ArmConfig(model=str(file)))


def run(follower, settings, learner, expert_qpos, seconds):
    """The learner's pose and the frame after a time."""
    for _ in range(round(seconds / TICK)):
        learner, frame = follower.step(settings, {}, learner, expert_qpos, TICK)
    return learner, frame


def test_an_exact_hand_is_where_the_expert_s_is(panda, env):
    learner = build_arm(env.learner, "hardware").embodiment
    settings = HandSettings("exact", base=(0.1, -0.2, 0.0, 0.5))
    qpos, frame = run(HandFollower(panda, env), settings, np.zeros(6), HOME, 4.0)
    assert frame.status.state == "tracking" and frame.note.startswith("hand tracking, ")
    target, reached = hand_poses(panda, HOME)[0], hand_poses(learner, qpos)[0]
    cosine, sine = np.cos(0.5), np.sin(0.5)
    placed = np.array([[cosine, -sine, 0, 0.1], [sine, cosine, 0, -0.2], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(placed @ reached, target, atol=1e-3)  # m, and sines of half a degree
    np.testing.assert_allclose(frame.positions[0], (np.linalg.inv(placed) @ target)[:3, 3], atol=1e-6)
    np.testing.assert_allclose(frame.rotations[0], (np.linalg.inv(placed) @ target)[:3, :3], atol=1e-6)


def test_a_clutch_takes_up_the_motion_where_it_is(panda, env):
    """Open, the expert moves alone; closed again, the hand moves from where it was by the scaled translation."""
    learner = build_arm(env.learner, "hardware").embodiment
    follower, settings = HandFollower(panda, env), HandSettings("relative", scale=0.5)
    start, _ = run(follower, settings, np.array([0.3, -1.2, 1.4, -1.0, -1.2, 0.2]), HOME, 0.5)
    opened = dataclasses.replace(settings, is_engaged=False)
    qpos, frame = run(follower, opened, start, HOME + 0.2, 1.0)
    assert frame.status.state == "disengaged" and np.isnan(frame.status.position_mm)
    np.testing.assert_allclose(qpos, start, atol=1e-4)
    qpos, _ = run(follower, settings, qpos, HOME + 0.2, 0.5)
    np.testing.assert_allclose(qpos, start, atol=2e-3)  # rad; the posture may move, the hand does not
    moved, _ = run(follower, settings, qpos, HOME + 0.25, 2.0)
    of_expert = hand_poses(panda, HOME + 0.25)[0, :3, 3] - hand_poses(panda, HOME + 0.2)[0, :3, 3]
    of_learner = hand_poses(learner, moved)[0, :3, 3] - hand_poses(learner, start)[0, :3, 3]
    np.testing.assert_allclose(of_learner, 0.5 * of_expert, atol=1e-3)


def test_what_is_driven_is_a_data_set(panda, env, tmp_path, capsys):
    """Each closing of the clutch and other place of the base begin an episode; other locks, another data set."""
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    session = LiveSession(env, hand=HandSettings("relative"), is_recorded=True)
    follower, learner = session._follower, np.array([0.3, -1.2, 1.4, -1.0, -1.2, 0.2])
    for settings in ({"is_engaged": True}, {"is_engaged": False}, {"is_engaged": True}, {"base": (0.1, 0, 0, 0)}):
        learner, _ = run(follower, HandSettings("relative", **settings), learner, HOME, 0.2)
    names = build_arm(env.learner).embodiment.joint_names
    _, frame = follower.step(HandSettings("relative"), {names[2]: 1.4}, np.delete(learner, 2), HOME, TICK, 0.25)
    assert frame.gripper == 0.25 and "gripper at 0.25" in frame.note
    config = ViewConfig(env=env, record=str(tmp_path / "driven") + "/")
    view._finish(config, session)
    assert f"3 episodes in {tmp_path}/driven\nview: 1 episodes in {tmp_path}/driven-1\n" in capsys.readouterr().out
    motions = read_lerobot(tmp_path / "driven", names, "action").motions
    np.testing.assert_allclose(list(motions.values())[-1].qpos[-1], learner, atol=1e-6)
    view._finish(config, LiveSession(env, is_recorded=True))
    assert "nothing was driven" in capsys.readouterr().out


def test_the_expert_moves_steadily_within_a_frame(panda, env):
    """Frames of 3 or 4 ticks in which the expert turns at 1 rad/s, with its last joint beyond half a revolution."""
    session = LiveSession(env, hand=HandSettings("relative"), is_recorded=True)
    follower, learner = session._follower, np.array([0.3, -1.2, 1.4, -1.0, -1.2, 0.2])
    follower._continuous = np.arange(7) == 6
    for frame in range(30):
        qpos = HOME + np.eye(7)[0] * TICK * frame
        qpos[6] = (2.9 + TICK * frame + np.pi) % (2 * np.pi) - np.pi
        learner, _ = follower.step(HandSettings("relative"), {}, learner, qpos, TICK)
    led = np.array([tick.leader for tick in session.driven[0]._episodes[0]])
    moved = np.diff(led[3:], axis=0)
    moved[:, 6] = (moved[:, 6] + np.pi) % (2 * np.pi) - np.pi
    assert np.all(moved[:, [0, 6]] > 0.008) and np.all(moved[:, [0, 6]] < 0.0115)


def test_what_is_out_of_reach_says_so(panda, env):
    qpos, frame = run(HandFollower(panda, env), HandSettings("exact", base=(3.0, 0, 0, 0)), np.zeros(6), HOME, 3.0)
    assert frame.status.state == "nearest" and frame.status.position_mm > 1000
    assert "mm and" in frame.note and len(frame.note.splitlines()) == 2
    lower, upper = build_arm(env.learner, "hardware").embodiment.joint_range.T
    assert np.all((lower - 1e-6 <= qpos) & (qpos <= upper + 1e-6))


@pytest.mark.parametrize(("values", "message"), [
    ({"hand": "free?"}, "hand: expected one of free, exact, relative"),
    ({"base": (0, 0, np.nan, 0)}, "base: expected .* all finite"),
    ({"scale": 0.0}, "scale: expected a finite number above 0"),
])  # fmt: skip
def test_settings_out_of_range(values, message):
    with pytest.raises(ValueError, match=message.replace("?", ".")):
        HandSettings(**values)


def test_a_dragged_hand_goes_there_within_the_limits(panda):
    drag, qpos = HandDrag(panda), HOME
    drag.goal = hand_poses(panda, HOME + 0.15)[0]
    for _ in range(90):
        before, qpos = qpos, drag.step(qpos, TICK)
        assert np.all(np.abs(qpos - before) <= mimic.arms.arm.finite_velocity_limit(panda) * TICK + 1e-6)
    assert drag.goal is None  # it has arrived
    np.testing.assert_allclose(hand_poses(panda, qpos)[0], hand_poses(panda, HOME + 0.15)[0], atol=1e-4)
    drag.goal = np.eye(4) + np.array([[0, 0, 0, 5.0]] * 1 + [[0] * 4] * 3)  # 5 m away
    for _ in range(300):
        qpos = drag.step(qpos, TICK)
    lower, upper = panda.joint_range.T
    assert np.all((qpos >= lower - 1e-6) & (qpos <= upper + 1e-6))
    assert hand_poses(panda, qpos)[0, 0, 3] > 0.7  # stretched towards it, of 0.855 m


@pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="needs viser: pip install 'mimic-arms[view]'")
def test_the_page_has_a_handle_a_tab_and_goals(env):
    from mimic.commands import view_server
    from mimic.viewer.hand_controls import HandControls
    from mimic.viewer.live_session import Frame
    from mimic.viewer.manual_controls import ManualControls

    config, done = ViewConfig(env=env, port=free_port()), []

    def show(page, times):
        session = LiveSession(env, hand=HandSettings("exact"))
        manual, controls = ManualControls(session, env), HandControls(session)
        manual.add_widgets(page.server)
        controls.add_widgets(page.server)
        assert controls._hand.value == "exact"
        np.testing.assert_allclose(manual._handle.position, hand_poses(session.expert, session.pose)[0, :3, 3])
        session.move(1, 0.6)
        manual.advance(0.1)
        np.testing.assert_allclose(manual._handle.position, hand_poses(session.expert, session.pose)[0, :3, 3])
        controls._place(3, 0.4)
        assert session.hand.base == (0, 0, 0, 0.4)
        angles = [dict.fromkeys(build_arm(arm).embodiment.joint_names, 0.1) for arm in (env.expert, env.learner)]
        for state, is_shown in (("tracking", True), ("nearest", True), ("waiting", False)):
            count = int(is_shown)
            status = TeleoperationStatus(state, "", 0.0, 0.0)
            hand = HandFrame(np.full((count, 3), 0.2), np.tile(np.eye(3), (count, 1, 1)), status)
            frame = Frame(angles[0], angles[1], (), (), (), 0.1, 0.1, np.eye(1), np.eye(1), {}, hand=hand)
            page.move(frame)
            goals = page._goals
            assert goals._axes[0].visible == is_shown and not page._ghost._root.visible
            done.append(tuple(goals._balls[0].color))
        page.move(dataclasses.replace(frame, hand=None))
        assert page._ghost._root.visible and not goals._axes[0].visible

    assert view_server.serve(config, env, "arms", show) == 0
    assert done[0] != done[1]
