"""Environments whose learner is drawn for each episode: the arms of their report, and what they reject."""

from pathlib import Path

import jax
import pytest

import mimic
from mimic.arms.arm import ArmConfig
from mimic.arms.embodiment import panda_path
from mimic.envs.family import SEEN, UNSEEN, arm_name, arm_sampler, report_arms, with_one_learner
from mimic.envs.many_arms import AnyArmEnv
from tests.helpers.untrained_run import family

FAMILIES = "panda_family", "any_arm"
SMALL = {"demonstrations": {"count": 2, "held_out": 1}, "horizon": 5}


@pytest.mark.parametrize("name", FAMILIES)
def test_make_returns_the_environment_of_any_arm(name):
    env = mimic.make(name, **SMALL)
    assert isinstance(env, AnyArmEnv) and env.demonstrations.count == 2
    assert env.config.physics == env.backend == "fused"


def test_registered_environments_of_many_arms_are_made_too(own_registry):
    arms = {"locked_fraction": 1.0, "most_locked": 0}
    mimic.register("environment", "few", {"expert": "panda", "arms": arms, "metric": {"hand_rotation": 0.0}})
    assert isinstance(mimic.make("few", **SMALL), AnyArmEnv)


def test_the_report_has_each_arm_once():
    arms = report_arms(family(arms={"random_fraction": 1.0}))
    assert list(arms[SEEN]) == ["whole", "locked 1", "locked 7"]
    assert list(arms[UNSEEN])[:5] == [f"locked {i}" for i in (2, 3, 4, 5, 6)]
    assert [int(arm.is_free.sum()) for arm in arms[SEEN].values()] == [7, 6, 6]
    assert list(arms[UNSEEN])[5:] == [f"random {i}" for i in range(16)]


def test_an_environment_of_one_learner():
    env = with_one_learner(family(), "panda", [2, 4])
    assert env.kind == "one_arm" and env.physics == "auto" and env.learner.locked == [2, 4]
    assert env.learner.armature == 0.1 and env.build_arms().learner.embodiment.num_joints == 5
    with pytest.raises(ValueError, match="panda_pair: expected a serial arm, got a tree of 2 chains"):
        with_one_learner(family(), "panda_pair", [])


def test_arms_are_named_by_their_files(tmp_path):
    names = "robots/ur5e/robot.xml", "robots/ur5e/arm.urdf"
    assert [arm_name(ArmConfig(model=str(tmp_path / name))) for name in names] == ["ur5e", "arm"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"physics": "mjx"}, "physics: expected auto or fused where the learner is drawn for each episode, got mjx"),
        ({"preview": 2}, "preview: expected 1 where .*, got 2"),
        (
            {"reward": {"terms": {"self_collision": 1.0}}},
            "reward: expected the default where .*, got terms=.*self_coll",
        ),
        ({"observation": {"terms": ["own"]}}, "observation: expected the default where .*, got terms="),
    ],
)
def test_settings_of_one_learner_are_rejected(own_registry, changes, message):
    mimic.register("observation_term", "own", lambda env, state: state.qpos)
    with pytest.raises(ValueError, match=message):
        mimic.make("panda_family", **changes)


def test_what_needs_one_learner_rejects_it():
    config = mimic.env_config("panda_family")
    for function in (config.build_arms, config.check_one_learner):
        with pytest.raises(ValueError, match="env: expected an environment of one learner, got 'panda_family', which"):
            function()


def test_arms_that_cannot_be_reported_or_drawn_are_rejected(tmp_path):
    files = [tmp_path / name / "arm.xml" for name in ("a", "b")]
    for file in files:
        file.parent.mkdir()
        file.write_text(Path(panda_path()).read_text())
    twice = family(arms={"evaluated": [str(file) for file in files]})
    with pytest.raises(ValueError, match="arms: expected models and evaluated of different names, got 'arm' twice"):
        report_arms(twice)
    with pytest.raises(ValueError, match="arms.unseen: expected at least one of the learner's 7 joints to move"):
        arm_sampler(family(arms={"unseen": ["1+2+3+4+5+6+7"]}))
    only_whole = arm_sampler(family(arms={"unseen": [str(i) for i in range(1, 8)]}))
    assert only_whole(jax.random.PRNGKey(0)).is_free.sum() == 7
