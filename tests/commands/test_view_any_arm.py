"""The live view with a pose mapper to any arm: learner and locks change while it runs, and nothing is compiled."""

import dataclasses

import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.commands.config import ViewConfig
from mimic.commands.view_any_arm import AnyLearnerFunctions, read_learners
from mimic.envs import env_config
from mimic.metric.similarity import centre_line, similarity
from mimic.viewer.live_session import LiveSession
from mimic.viewer.tracking import shown_preset
from tests.helpers.compilations import count_compilations
from tests.helpers.original_model import ur_like

TICK = 1 / 30
POSE = np.array([0.4, 0.6, -0.3, -1.2, 0.5, 1.0, 0.2], np.float32)  # of the expert [rad]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def mapper():
    return mimic.load("any_arm", "pose_mapper")


@pytest.fixture(scope="module")
def choices(mapper, tmp_path_factory):
    """Two arms, a Panda and one with six joints, and their presets."""
    path = tmp_path_factory.mktemp("arms") / "six.xml"
    path.write_text(ur_like(gripper=""))
    named = ViewConfig(mapper="any_arm", learners=["panda4dof", str(path)]).resolve_learners(ArmConfig())
    return read_learners(named, mapper.env.limits, mapper.env.metric.links)


@pytest.fixture(scope="module")
def functions(mapper, choices):
    compiled = AnyLearnerFunctions(mapper, choices[0])
    compiled.finish()
    return compiled


@pytest.fixture
def live(mapper, functions):
    learner = env_config("panda4dof").learner
    return LiveSession(dataclasses.replace(mapper.env, arms=None, learner=learner), any_arm=functions)


def choose(live, choices, name):
    arms, presets = choices
    preset = next(preset for preset in presets if preset.name == name)
    start = arms[preset.arm].arm.embodiment
    live.choose(preset.arm, preset.locked, dict(zip(start.joint_names, map(float, start.home), strict=True)))


def settle(live):
    """The last frame before the arms come to rest."""
    frames = []
    for _ in range(300):
        frame = live.advance(TICK)
        if frame is None:
            return frames[-1]
        frames.append(frame)
    raise AssertionError("the learner does not come to rest")


def test_the_choices_are_the_named_learners_and_each_arm_without_locks(choices):
    arms, presets = choices
    assert [arm.arm.embodiment.num_joints for arm in arms] == [7, 6]
    assert [(preset.name, preset.arm, len(preset.locked)) for preset in presets] == [
        ("panda4dof", 0, 3), ("six", 1, 0), ("panda", 0, 0)
    ]  # fmt: skip
    assert shown_preset(presets, 0, {"joint3": 0.0, "joint7": 0.0, "joint6": 0.0}).name == "panda4dof"
    assert shown_preset(presets, 0, {"joint3": 0.1}).name == "panda"
    assert shown_preset(presets, 1, {"a": 0.1}).name == "six"


def test_arms_locks_and_weights_change_without_compiling(live, choices):
    rng, shown = np.random.default_rng(0), set()
    settle(live)
    with count_compilations() as events:
        for step in range(60):
            live.show_pose(np.clip(live.pose + 0.1 * rng.standard_normal(7), -1.5, 1.5))
            if step % 10 == 3:
                choose(live, choices, ("six", "panda", "panda4dof")[step // 10 % 3])
            elif step % 3 == 0:
                names = choices[0][live.settings.arm].arm.embodiment.joint_names
                joint = names[rng.integers(len(names))]
                live.lock(joint, joint not in live.settings.locked)
            elif step % 10 == 5:
                live.change(translation=float(rng.integers(3)), rotation=float(rng.integers(3)))
            frame = live.advance(TICK)
            assert frame is not None and frame.arm == live.settings.arm  # at once, in the next frame
            assert set(frame.locked) == set(live.settings.locked) and not live.is_compiling
            assert np.isfinite(frame.distance) and np.isfinite(frame.bound) and np.all(np.isfinite(frame.links))
            shown.add((frame.arm, frame.locked))
    assert events == [] and len(shown) > 15


@pytest.mark.parametrize(("name", "locked"), [("panda", ("joint2", "joint5")), ("six", ())])
def test_what_is_shown_is_the_metric_of_the_built_arm(live, mapper, choices, name, locked):
    choose(live, choices, name)
    live.show_pose(POSE)
    settle(live)
    for joint in locked or choices[0][1].arm.embodiment.joint_names[1:3]:
        live.lock(joint, True)
    live.show_pose(-0.5 * POSE)
    frame = settle(live)
    config = dataclasses.replace(choices[0][live.settings.arm].config, locked=dict(live.settings.locked))
    expert, learner = mapper.expert, build_arm(config, mapper.env.limits).embodiment
    poses = [
        np.array([angles[joint] for joint in arm.joint_names], np.float32)
        for arm, angles in ((expert, frame.expert), (learner, frame.learner))
    ]
    metric = mapper.env.metric.build(expert, learner)
    states = mimic.link_states(expert, poses[0]), mimic.link_states(learner, poses[1])
    links = metric.link_distances(*states)
    np.testing.assert_allclose(frame.links, links, atol=2e-5)  # float32 of two functions
    np.testing.assert_allclose(frame.matrix, metric.matrix(links), atol=1e-4)
    np.testing.assert_allclose(frame.distance, metric.reduced(links), atol=1e-5)
    for key, value in similarity(centre_line(expert, poses[0]), centre_line(learner, poses[1])).items():
        np.testing.assert_allclose(frame.similarity[key], value, atol=2e-2 if key.endswith("_deg") else 1e-5)
    assert frame.learner_links == learner.link_names
    best = mimic.imitate_pose(expert, learner, poses[0], **metric.arguments)
    assert frame.bound == pytest.approx(float(best.distance), abs=2e-3)  # both are searches from some guesses
    assert frame.bound <= frame.distance


def test_a_joint_is_locked_where_it_is_and_freed_again(live, choices):
    choose(live, choices, "panda")
    live.show_pose(POSE)
    free = settle(live)
    live.lock("joint4", True)
    frame = settle(live)
    assert live.settings.locked == {"joint4": free.learner["joint4"]} and frame.locked == ("joint4",)
    live.show_pose(0 * POSE)
    moved = settle(live)
    assert moved.learner["joint4"] == pytest.approx(free.learner["joint4"], abs=1e-6)  # float32
    largest = max(abs(moved.learner[name] - angle) for name, angle in free.learner.items())
    assert moved.distance > 0.05 and largest > 0.1  # the others move on
    live.lock("joint4", False)
    assert settle(live).distance < 1e-3  # an equal arm in an equal pose


def test_a_learner_that_does_not_fit_is_named(mapper):
    with pytest.raises(ValueError, match="learners: two: panda_pair.*expected a serial arm, got a tree of 2 chains"):
        read_learners({"two": ArmConfig(model="panda_pair")}, mapper.env.limits, mapper.env.metric.links)
