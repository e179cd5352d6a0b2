"""Registered reward and observation terms, environment classes and demonstration sources."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.envs.config import EnvConfig
from mimic.envs.imitation import layout_of
from mimic.envs.make import make_env
from mimic.evaluation.evaluator import Evaluator
from mimic.evaluation.references import References
from mimic.metric.capsule_distances import capsule_axes, pair_distances
from mimic.metric.kinematics import link_state_table

SMALL = {"horizon": 5, "demonstrations": {"count": 2, "held_out": 1}}


def height(env, transition):
    """Height of the last link [chain lengths], and a part of the torque."""
    return transition.learner_states.position[-1, 1] - 0.1 * jnp.abs(transition.action).max()


def one_step(env, action):
    return jax.jit(lambda key: env.step(env.reset(key), action))(jax.random.PRNGKey(0))


def angles(env, state):
    return state.qpos


def demonstration(env, state):
    return state.demonstration[None]


@pytest.fixture
def terms(own_registry):
    mimic.register("reward_term", "height", height)
    mimic.register("observation_term", "angles", angles)
    mimic.register("observation_term", "demonstration", demonstration)
    return {"reward": {"terms": {"height": 0.5}}, "observation": {"terms": ["angles", "demonstration"]}}


def test_terms_are_added(terms):
    plain = mimic.make("planar4dof", physics="fused", **SMALL)
    env = make_env(mimic.env_config("planar4dof", physics="fused", **SMALL, **terms))
    action = jnp.array([0.5, -0.2, 0.1, 0.0])
    states = [one_step(plain, action), one_step(env, action)]
    arm = states[1].pipeline_state
    expected = mimic.link_states(env.learner, arm.qpos, arm.qvel).position[-1, 1] - 0.05
    np.testing.assert_allclose(states[1].metrics["reward/height"], expected, atol=1e-5)  # float32
    np.testing.assert_allclose(states[1].reward, states[0].reward + 0.5 * expected, atol=1e-5)
    np.testing.assert_array_equal(states[1].obs[: plain.observation_size], states[0].obs)
    np.testing.assert_array_equal(states[1].obs[plain.observation_size :], [*arm.qpos, arm.demonstration])
    assert env.observation_size == plain.observation_size + 5 == states[1].obs.size
    layout = layout_of(env)
    assert [part["name"] for part in layout[-2:]] == ["term: angles", "term: demonstration"]
    assert layout[-1]["stop"] == env.observation_size and layout_of(plain)[-1]["stop"] == plain.observation_size


@pytest.mark.slow
def test_self_collision_is_charged_by_the_distances_of_capsules():
    """The intrusion of capsules into 5 cm, for a pose that folds the hand to the upper arm."""
    plain = mimic.make("panda7dof", physics="fused", **SMALL)
    env = mimic.make("panda7dof", physics="fused", reward={"terms": {"self_collision": 0.5}}, **SMALL)
    action, folded = jnp.zeros(7), jnp.array([0.0, 0.6, 0.0, -2.95, 0.0, 0.5, 0.0])
    rewards, arm = [], None
    for each in (plain, env):
        start = each.reset(jax.random.PRNGKey(0))
        start = start.replace(pipeline_state=dataclasses.replace(start.pipeline_state, qpos=folded))
        state = jax.jit(each.step)(start, action)
        rewards.append(float(state.reward))
        arm = state.pipeline_state
    distances = pair_distances(env.capsules, *capsule_axes(env.learner, env.capsules, arm.qpos))
    intrusion = float((np.maximum(0, 1 - distances[env.changing_pairs] / 0.05) ** 2).sum())
    expected = -intrusion / (1 + intrusion)
    assert not env.changing_pairs[env.capsules.pairs.index((8, 10))] and -1 < expected < -0.1
    assert state.metrics["reward/self_collision"] == pytest.approx(expected, abs=2e-3)  # smoothed by 0.1 mm, float32
    assert rewards[1] - rewards[0] == pytest.approx(0.5 * expected, abs=1e-3)


def test_a_built_in_term_cannot_be_registered():
    with pytest.raises(ValueError, match="'self_collision' is built in"):
        mimic.register("reward_term", "self_collision", height)


def test_ending_an_episode_early_is_never_better(own_registry, monkeypatch):
    """A term of either sign counts as a loss of its weight."""
    monkeypatch.setattr(EnvConfig, "speed_bound", 0.001)
    mimic.register("reward_term", "gain", lambda env, transition: jnp.ones(()))
    mimic.register("reward_term", "loss", lambda env, transition: -jnp.ones(()))
    env = mimic.make("planar4dof", physics="fused", reward={"terms": {"gain": 0.5, "loss": -0.3}}, **SMALL)
    state = one_step(env, jnp.ones(4))
    assert state.done == 1 and (state.metrics["reward/gain"], state.metrics["reward/loss"]) == (-1, 1)
    np.testing.assert_allclose(state.reward, -5 * (env._worst_distance + 0.8), rtol=1e-6)


def test_a_runaway_is_charged_the_own_distance(own_registry):
    mimic.register("link_distance", "squared", lambda a, b: ((a.position - b.position) ** 2).sum())
    env = mimic.make("planar4dof", physics="fused", metric={"link_distance": "squared"}, **SMALL)
    matrix = np.asarray(env.metric.correspondence)
    assert env._worst_distance == pytest.approx(4 * matrix.mean() + 0.02 * np.pi)  # opposite ends and hands


@pytest.mark.parametrize(
    ("kind", "thing", "settings", "message"),
    [
        ("reward_term", lambda env, t: t.after.qpos, {"reward": {"terms": {"bad": 1.0}}}, r"a number, got shape \[4\]"),
        ("reward_term", lambda env, t: t.speed, {"reward": {"terms": {"bad": 1.0}}}, "reward_term 'bad': AttributeErr"),
        ("demonstrations", lambda expert, config: None, {"demonstrations": {"source": "bad"}}, "expected Demonst"),
        ("environment", dict, {"environment": "bad"}, "expected a subclass of ImitationEnv"),
    ],
)  # fmt: skip
def test_a_thing_that_fails_or_returns_something_else_is_one_line(own_registry, kind, thing, settings, message):
    mimic.register(kind, "bad", thing)
    with pytest.raises(ValueError, match=message):
        mimic.make("planar4dof", physics="fused", **{**SMALL, **settings})


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (lambda env, state: state.step, r"observation_term 'bad': expected a vector, got shape \[\]"),
        (lambda env, state: {}["speed"], "observation_term 'bad': KeyError: 'speed'"),
    ],
)
def test_an_observation_term_that_fails_is_one_line(own_registry, term, message):
    mimic.register("observation_term", "bad", term)
    env = mimic.make("planar4dof", physics="fused", observation={"terms": ["bad"]}, **SMALL)
    with pytest.raises(ValueError, match=message):
        _ = env.observation_size


def test_the_report_has_the_mean_of_a_reward_term(terms, monkeypatch):
    env = mimic.make("planar4dof", physics="fused", **SMALL, **terms)
    evaluator = Evaluator(env, env.demonstrations.select([0]))
    zeros = np.zeros((3, 5))  # in place of the bound and the baselines, which are not under test
    monkeypatch.setattr(evaluator, "_references", lambda: References(zeros, zeros, {}))
    rollouts = jax.jit(lambda: evaluator.rollout(lambda state: jnp.full(4, 0.5)))()
    last = link_state_table(env.learner, np.asarray(rollouts.qpos), np.asarray(rollouts.qvel)).position[:, :, -1, 1]
    expected = np.mean(last - 0.05, axis=1)
    summary = evaluator.summary(rollouts)
    assert summary["reward.height"]["train"] == pytest.approx(expected[:2].mean(), abs=1e-5)  # float32
    assert summary["reward.height"]["held_out"] == pytest.approx(expected[2], abs=1e-5)


def test_terms_are_named_once_with_finite_weights(terms):
    with pytest.raises(ValueError, match="expected each term once, got 'angles' twice"):
        mimic.env_config("planar4dof", observation={"terms": ["angles", "angles"]})
    with pytest.raises(ValueError, match="reward.terms: expected a number from -1e.06 to 1e.06"):
        mimic.env_config("planar4dof", reward={"terms": {"height": float("inf")}})


def test_a_registered_class_is_made(own_registry):
    class Angles(mimic.ImitationEnv):
        preset = {
            "learner": {"model": "planar", "link_lengths": [0.5, 0.5]},
            "expert": {"model": "planar", "link_lengths": [1.0]},
        }

        def observe(self, state):
            return state.qpos

    mimic.register("environment", "angles", Angles)
    env = mimic.make("angles", physics="fused", **SMALL)
    assert isinstance(env, Angles) and env.config.environment == env.config.name == "angles"
    assert env.observation_size == 2 and layout_of(env)[0]["name"] == "observation of Angles"


def test_terms_that_a_class_does_not_observe_are_rejected(terms):
    class Bare(mimic.ImitationEnv):
        def observe(self, state):
            return state.qpos

    class More(mimic.ImitationEnv):
        def observe(self, state):
            return jnp.append(super().observe(state), 7.0)

    config = mimic.env_config("planar4dof", physics="fused", **SMALL, observation=terms["observation"])
    message = r"observation.terms: expected none with Bare, whose observe\(\) leaves them out, got \['angles', "
    with pytest.raises(ValueError, match=message):
        _ = Bare(config).observation_size
    assert More(config).observation_size == mimic.ImitationEnv(config).observation_size + 1


def test_demonstrations_are_those_of_a_source(own_registry):
    recorded = mimic.make("planar4dof", physics="fused", **SMALL).demonstrations

    def slower(expert, config):
        count = config.demonstrations.count + config.demonstrations.held_out
        motions = recorded.select([0] * count)
        return dataclasses.replace(motions, qpos=0.5 * motions.qpos, qvel=0.5 * motions.qvel, torque=None)

    mimic.register("demonstrations", "slower", slower)
    settings = {**SMALL, "demonstrations": {**SMALL["demonstrations"], "source": "slower"}}
    env = mimic.make("planar4dof", physics="fused", **settings)
    np.testing.assert_array_equal(env.demonstrations.qpos[1], 0.5 * recorded.qpos[0])
    mimic.register("demonstrations", "slower", lambda expert, config: recorded, replace=True)
    with pytest.raises(ValueError, match="'slower' has 2, expected at least count . held_out = 2 . 1"):
        mimic.make("planar4dof", physics="fused", **settings)
