"""The session of the live view, without a browser: motion, values, and settings."""

import dataclasses

import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm, finite_velocity_limit
from mimic.arms.link_match import hand_poses
from mimic.envs import env_config
from mimic.trainers import run_training as train
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.viewer.live_session import LiveSession
from mimic.viewer.tracking import Settings, initial_settings, learner_arm, step_towards

TICK = 1 / 30


@pytest.fixture(scope="module")
def env():
    return env_config("panda4dof")


@pytest.fixture
def live(env, compiled):
    """A new session that shares compiled functions with the other tests."""
    session = LiveSession(env)
    session._functions = compiled
    return session


@pytest.fixture(scope="module")
def compiled(env):
    session = LiveSession(env)
    session.compile()
    return session._functions


def settle(session, seconds=6.0):
    """The last frame before the arms come to rest."""
    frame = None
    for _ in range(int(seconds / TICK)):
        after = session.advance(TICK)
        if after is None:
            assert frame is not None
            return frame
        frame = after
    raise AssertionError("the learner does not come to rest")


def test_what_is_no_number_changes_nothing(live):
    before = live.pose
    for angle in (float("nan"), float("inf")):
        live.move(1, angle)
        assert np.array_equal(live.pose, before)
    for weight in (float("nan"), float("inf"), -0.1):
        with pytest.raises(ValueError, match="rotation: expected a finite weight of at least 0"):
            live.change(rotation=weight)


def test_the_learner_tracks_and_rests_at_the_bound(live):
    start = settle(live)
    assert start.bound <= start.distance < start.bound * 1.01  # the tolerance at which it stops searching, ten times
    live.move(1, 0.8)
    frame = settle(live)
    assert frame.expert["joint2"] == pytest.approx(0.8) and frame.learner != start.learner
    # Both may be 0 but for rounding: 1e-7, the precision of float32.
    assert frame.bound - 1e-7 <= frame.distance < frame.bound * 1.01 + 1e-7
    assert live.advance(TICK) is None  # nothing is computed while nothing moves


def test_a_shown_pose_is_tracked_and_a_jump_seeks_the_best_pose(live):
    """From where it is, tracking ends in a local minimum at this pose; `seek` ends at the bound while poses arrive."""
    pose = np.array([-0.34, 0.41, 2.45, -1.47, 0.53, -0.85, 1.54], np.float32)
    frames = []
    for seeks in (False, True):
        if seeks:
            live.seek()
        for _ in range(120):
            live.show_pose(pose + 1e-3 * np.random.default_rng(0).standard_normal(7))  # never at rest
            frame = live.advance(TICK)
        frames.append(frame)
    assert frames[1].expert["joint1"] == pytest.approx(-0.34, abs=0.01)
    assert frames[0].distance > 1.05 * frames[0].bound
    assert frames[1].distance < 1.01 * frames[1].bound
    live.show_pose(np.full(7, np.nan))
    assert np.isfinite(live.pose).all()


def test_what_is_shown_is_the_metric(live, env):
    live.move(0, 0.5)
    frame = settle(live)
    expert, learner = (build_arm(arm, "none").embodiment for arm in (env.expert, env.learner))
    expert_states, learner_states = (
        mimic.link_states(arm, np.array([angles[name] for name in arm.joint_names], np.float32))
        for arm, angles in ((expert, frame.expert), (learner, frame.learner))
    )
    matrix = mimic.arc_length_correspondence(expert, learner)
    of_links, distance = (
        mimic.embodiment_distance(
            expert_states, learner_states, matrix, mimic.DistanceWeights(1.0, 1.0), hand_weights=mimic.HandWeights(hand)
        )
        for hand in (0.0, 0.02)
    )
    np.testing.assert_allclose(frame.distance, distance, atol=1e-5)  # float32 of two functions
    np.testing.assert_allclose(frame.matrix, matrix, atol=1e-6)
    np.testing.assert_allclose((frame.matrix * frame.links).mean(), of_links, atol=1e-5)
    assert frame.expert_links == expert.link_names and frame.learner_links == learner.link_names


def test_no_joint_of_the_learner_jumps(live, env):
    arm = learner_arm(env, live.settings.locked).embodiment
    frame = settle(live)
    rng = np.random.default_rng(1)
    for step in range(90):
        if step % 30 == 0:
            live.glide(rng.uniform(-2, 2, 7))
        after = live.advance(TICK)
        assert after is not None
        change = [after.learner[name] - frame.learner[name] for name in arm.joint_names]
        change = np.abs(np.angle(np.exp(1j * np.array(change))))
        assert np.all(change <= finite_velocity_limit(arm) * TICK + 1e-5)  # rounding of angles near pi
        frame = after


def test_the_expert_plays_a_motion_and_a_slider_ends_it(live):
    times, poses = np.array([0.0, 0.2, 0.4]), np.zeros((3, 7))
    poses[:, 3] = 0.0, -0.4, -1.0
    live.play(times, poses)
    assert live.moves_by_itself
    for _ in range(6):
        live.advance(TICK)
    assert live.pose[3] == pytest.approx(-0.4, abs=1e-5)
    live.move(0, 9.0)
    assert not live.moves_by_itself and live.pose[0] == pytest.approx(np.pi)  # within the joint's range


def test_weights_change_without_compiling_and_the_distance_scales(live):
    live.move(1, 0.7)
    live.move(2, 1.0)  # a joint that the learner has not; in the zero pose, joint 0 has the same axis
    before = settle(live).distance
    assert before > 1e-2
    live.change(translation=2.0, rotation=2.0)
    frame = live.advance(TICK)
    assert frame is not None and frame.distance == pytest.approx(2 * before, rel=1e-3)  # the minimum stays in its place


def test_a_hand_that_follows_is_where_the_dragged_one_of_the_expert_is(live, env):
    """A relative hand of half the scale; an impossible setting leaves the hand to the metric, with an error."""
    settle(live)
    live.follow_hand(hand="relative", scale=0.5)
    start = live.advance(TICK)
    goal = hand_poses(live.expert, live.pose)[0]
    goal[:3, 3] += [0.1, 0.0, -0.08]
    live.drag_hand(goal)
    assert live.moves_by_itself
    frame = settle(live, 12.0)
    np.testing.assert_allclose(hand_poses(live.expert, live.pose)[0], goal, atol=1e-3)
    assert start.hand is not None and frame.hand is not None
    np.testing.assert_allclose(frame.hand.positions - start.hand.positions, [[0.05, 0.0, -0.04]], atol=1e-3)
    assert frame.hand.status.state == "nearest" and "out of reach: the nearest hand is" in frame.hand.note
    assert frame.hand.status.position_mm < 3  # four joints: the position counts first
    with pytest.raises(ValueError, match="scale"):
        live.follow_hand(scale=0.0)
    live.follow_hand(hand="free")
    assert settle(live).hand is None


@pytest.mark.slow
def test_the_view_goes_on_while_another_correspondence_is_compiled():
    session = LiveSession(env_config("planar4dof"))
    session.compile()
    first = settle(session)
    session.change(correspondence="hard")
    session.move(0, 0.5)
    during = session.advance(TICK)
    assert during is not None and session.is_compiling
    np.testing.assert_array_equal(during.matrix, first.matrix)
    session.compile()
    after = session.advance(TICK)
    assert after is not None and set(np.unique(after.matrix)) <= {0, 1, 2} and np.any(after.matrix != first.matrix)


def test_locked_joints_switch_the_learner(env):
    session = LiveSession(dataclasses.replace(env, learner=ArmConfig(locked={"joint3": 0.4})))
    session.lock("joint6", True)
    assert session.settings.locked == {"joint3": 0.4, "joint6": 0.0}
    session.lock("joint3", False)
    fewer = learner_arm(env, session.settings.locked)
    assert fewer.embodiment.num_joints == 6 and fewer.locked == {"joint6": 0.0}
    session.lock("joint3", True)  # at the angle of the config again
    assert session.settings.locked == {"joint6": 0.0, "joint3": 0.4}
    with pytest.raises(ValueError, match="joint9"):
        learner_arm(env, {"joint9": 0.0})


@pytest.mark.slow
def test_a_trained_mapper_moves_the_learner(tmp_path):
    tiny = {"samples": 256, "batch_size": 128, "epochs": 1, "hidden_layers": [8], "held_out_poses": 32}
    trainer = PoseMapperConfig(**tiny, evaluations=1, validation_poses=32)
    env = env_config("planar4dof")
    config = TrainConfig(env, trainer, run_dir=str(tmp_path / "run"), compilation_cache="")
    assert train.prepare_training(config, 0.0)() == 0
    mapper = mimic.PoseMapper.load(tmp_path / "run")
    session = LiveSession(env, mapper)
    session.compile()
    session.move(2, 0.7)
    frame = settle(session)
    np.testing.assert_allclose(list(frame.learner.values()), mapper(session.pose), atol=1e-4)  # float32, two functions
    assert frame.bound < frame.distance  # it has hardly learned anything


def test_locking_the_last_joint_is_rejected_and_undone():
    session = LiveSession(env_config("planar4dof"))
    before = session.settings
    for joint in ("joint1", "joint2", "joint3", "joint4"):
        session.lock(joint, True)
    with pytest.raises(ValueError, match="all 4 joints are locked"):
        session.advance(TICK)
        session.finish()
        session.advance(TICK)
    assert session.settings == before


def test_settings_that_differ_only_in_weights_share_functions(env):
    settings = initial_settings(env)
    assert (
        settings.locked == dict.fromkeys(("joint3", "joint6", "joint7"), 0.0)
        and settings.correspondence == "arc_length"
    )
    assert dataclasses.replace(settings, rotation=0.3).compilation_key == settings.compilation_key
    assert dataclasses.replace(settings, correspondence="hard").compilation_key != settings.compilation_key
    with pytest.raises(ValueError, match="expected one of arc_length, overlap, hard, soft"):
        Settings({}, "none", 0.0, 1.0)


def test_a_joint_takes_the_shorter_way_around():
    arm = mimic.panda()
    pose, is_there = step_towards(arm, np.full(7, 3.1), np.full(7, -3.1), np.full(7, 0.05))
    np.testing.assert_allclose(pose, 3.15 - 2 * np.pi)
    assert is_there is False
    assert step_towards(arm, np.zeros(7), np.full(7, 0.01), np.full(7, 0.05))[1]
