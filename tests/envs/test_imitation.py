"""The environment: observations, rewards, ends of episodes, and its config."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.envs.imitation import limit_excess, training_and_held_out
from mimic.envs.wrappers import fresh_episodes, wrap_for_training
from tests.helpers.tiny import SHORT_ARMS

FEW = {"count": 6, "held_out": 2}


@pytest.fixture(scope="module")
def planar_env():
    return mimic.make("planar4dof", **SHORT_ARMS, demonstrations=FEW)


def test_an_episode_draws_its_demonstration_and_the_next_key_of_two_parts(planar_env):
    key = jax.random.PRNGKey(3)
    key_demonstration, key_next = jax.random.split(key)
    state = planar_env.start(key)
    assert state.key.tolist() == key_next.tolist()
    assert state.demonstration == jax.random.randint(key_demonstration, (), 0, planar_env.demonstrations.count)


OF_MANY_ARMS = ("any_arm", "panda_family")
QUICK = ("planar4dof", "panda3dof")


@pytest.mark.slow_for(*(name for name in mimic.environments() if name not in QUICK))
@pytest.mark.parametrize("name", mimic.environments())
def test_every_environment_resets_and_steps(name):
    env = mimic.make(name, demonstrations=FEW, limits="hardware", physics="fused")
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    after = jax.jit(env.step)(state, jnp.zeros(env.action_size))
    assert after.obs.shape == (env.observation_size,)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert np.all(np.isfinite(after.obs)) and not after.done
    if name in OF_MANY_ARMS:  # the reward is relative to the zero action
        assert after.reward == 0 < after.metrics["distance"] < 1.1 * after.pipeline_state.hold
    else:  # at rest at home, far from any limit
        assert after.reward == pytest.approx(-float(after.metrics["distance"]))


def test_the_default_physics_is_resolved_and_can_be_replaced(planar_env):
    env = planar_env
    assert mimic.env_config("planar4dof").physics == "auto" and env.config.physics == env.backend == "fused"
    on_mjx = env.with_physics("mjx")
    assert on_mjx.config.physics == on_mjx.backend == "mjx" and env.config.physics == "fused"
    assert on_mjx.demonstrations is env.demonstrations


def test_reward_and_observation_follow_the_demonstration_step_by_step():
    """After i steps both use sample i of the demonstration. 1e-5: float32, of a table made in double precision."""
    env = mimic.make("planar4dof", **SHORT_ARMS, preview=2, horizon=6, demonstrations=FEW, observation={"terms": []})
    motions, which = env.demonstrations, 3
    expert_states, learner_states = (
        jax.jit(functools.partial(mimic.link_states, arm)) for arm in (env.expert, env.learner)
    )
    expert = [
        expert_states(*(np.asarray(x[which, sample], np.float32) for x in (motions.qpos, motions.qvel)))
        for sample in range(7)
    ]
    distance = jax.jit(lambda expert, learner: mimic.embodiment_distance(expert, learner, **env.metric.arguments))
    actions = np.random.default_rng(0).uniform(-1, 1, (6, env.action_size)).astype(np.float32)
    state, step = jax.jit(lambda key: env.begin(env.start(key, which)))(jax.random.PRNGKey(0)), jax.jit(env.step)
    for i in range(7):
        arm = state.pipeline_state
        learner = learner_states(arm.qpos, arm.qvel)
        shown = [learner, *(expert[min(i + ahead, 6)] for ahead in range(3))]  # the last sample stays
        parts = [
            np.ravel(part)
            for states in shown
            for part in (
                *(states.position, states.direction, states.linear_velocity, states.angular_velocity),
                *(states.hand.axes[0], states.hand.axes[2]),
            )
        ]
        parts += [np.sin(arm.qpos), np.cos(arm.qpos), arm.qvel]
        np.testing.assert_allclose(state.obs, np.concatenate(parts), atol=1e-5)
        assert state.done == (i == 6)
        distances = [distance(each, learner) for each in expert]
        if i > 0:
            assert state.reward == pytest.approx(-float(distances[i]), abs=1e-5)
            others = np.delete(distances, i)
            assert np.abs(others - distances[i]).min() > 1e-4  # another sample would be noticed
        if i < 6:
            state = step(state, actions[i])


def test_episodes_end_at_the_horizon_and_draw_new_demonstrations(planar_env):
    env = wrap_for_training(planar_env, planar_env.config.horizon + 1)
    count, horizon = 32, planar_env.config.horizon

    @jax.jit
    def rollout(state):
        def step(state, _):
            state = env.step(state, jnp.zeros((count, planar_env.action_size)))
            arm = state.pipeline_state
            return state, (state.done, state.info["truncation"], arm.demonstration, arm.step)

        return jax.lax.scan(step, state, None, length=3 * horizon)[1]

    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), count))
    assert len(np.unique(state.pipeline_state.step)) > 10  # the first episodes are out of step with each other
    done, truncation, demonstration, step = map(np.asarray, rollout(state))
    assert np.all(done.sum(axis=0) == 3)
    assert not truncation.any()
    assert np.all(step[done.astype(bool)] == 0)
    assert all(len(np.unique(demonstration[:, i])) > 1 for i in range(count) if i % 8 == 0)


def test_a_function_that_jax_has_stays(planar_env, monkeypatch):
    monkeypatch.setattr(jax, "device_put_replicated", "of JAX", raising=False)
    mimic.ImitationEnv(planar_env.config, planar_env.demonstrations)
    assert jax.device_put_replicated == "of JAX"


class JointsAndStep(mimic.ImitationEnv):
    """An environment with an observation of its own."""

    def observe(self, state):
        return jnp.concatenate([state.qpos, state.qvel, state.step[None].astype(jnp.float32)])


class MoreThanLinks(mimic.ImitationEnv):
    """An environment that adds to the observation."""

    def observe(self, state):
        return jnp.append(super().observe(state), 7.0)


def test_an_overridden_observation_is_observed_everywhere():
    env = JointsAndStep(mimic.env_config("planar4dof", **SHORT_ARMS, demonstrations=FEW))
    assert env.observation_size == 5
    episodes = fresh_episodes(env)
    state = jax.jit(episodes.reset)(jax.random.split(jax.random.PRNGKey(0), 3))  # at random steps
    states = [state, jax.jit(episodes.step)(state, jnp.ones((3, 2)))]
    states.append(jax.jit(env.restart_done)(states[-1].replace(done=jnp.array([1.0, 0.0, 1.0]))))
    for state in states:
        np.testing.assert_array_equal(state.obs, jax.vmap(env.observe)(state.pipeline_state))
    assert states[2].obs[:, 4].tolist() == [0, states[1].obs[1, 4], 0]
    assert jax.eval_shape(env.reset, jax.random.PRNGKey(0)).obs.shape == (5,)


def test_an_observation_is_extended_and_others_stay():
    config = mimic.env_config("planar4dof", **SHORT_ARMS, demonstrations=FEW)
    plain, extended = mimic.ImitationEnv(config), MoreThanLinks(config)
    assert extended.observation_size == plain.observation_size + 1
    first, action = jax.jit(plain.reset)(jax.random.PRNGKey(0)), jnp.ones(2)
    for state, expected in (
        (jax.jit(extended.reset)(jax.random.PRNGKey(0)), first),
        (jax.jit(extended.step)(first, action), jax.jit(plain.step)(first, action)),
    ):
        np.testing.assert_allclose(state.obs, np.append(expected.obs, 7), atol=1e-5)  # float32, of a table in float64


def test_a_runaway_ends_the_episode_and_never_pays(planar_env):
    state = planar_env.reset(jax.random.PRNGKey(0))
    fast = state.pipeline_state.replace(qvel=jnp.full(2, 100.0))
    after = jax.jit(planar_env.step)(state.replace(pipeline_state=fast), jnp.zeros(2))
    assert after.done == 1 and after.metrics["runaway"] == 1
    worst_rest = -planar_env.config.horizon * float(after.metrics["distance"])
    assert after.reward == pytest.approx(worst_rest, rel=1e-5)


def test_an_action_of_another_length_is_rejected(planar_env):
    state = jax.eval_shape(planar_env.reset, jax.random.PRNGKey(0))
    with pytest.raises(ValueError, match=r"action: expected shape \(2,\), got \(3,\)"):
        jax.eval_shape(planar_env.step, state, jnp.zeros(3))


def test_hardware_limits_are_penalised_near_and_beyond_them():
    free = mimic.make("panda4dof", demonstrations=FEW)
    limited = mimic.make("panda4dof", demonstrations=FEW, limits="hardware", limit_weight=2.0)
    home, still = jnp.asarray(limited.learner.home, jnp.float32), jnp.zeros(4)
    upper, limit = limited.learner.joint_range[:, 1], limited.learner.velocity_limit
    assert limit_excess(limited.learner, home, still) == 0
    beyond = limit_excess(limited.learner, home.at[0].set(upper[0] + 0.02), still)
    assert beyond == pytest.approx(0.5 * (0.02 + 0.03) / 0.1 / 4, rel=1e-3)  # 3e-7 of an angle, over 0.05
    assert limit_excess(limited.learner, home.at[0].set(upper[0] + 9.0), still) == pytest.approx(0.5 / 4)
    assert limit_excess(limited.learner, home, still.at[1].set(-1.5 * limit[1])) == pytest.approx(0.5 / 4)
    for env, weight in ((free, 0.0), (limited, 2.0)):
        state = env.reset(jax.random.PRNGKey(0))
        arm = state.pipeline_state.replace(qvel=still.at[1].set(1.2 * limit[1]))
        step = jax.jit(env.step)
        after = step(state.replace(pipeline_state=arm), still)
        costs = after.metrics["distance"] + weight * after.metrics["limit_excess"]
        assert after.metrics["limit_excess"] > 0 and after.metrics["runaway"] == 0
        assert after.reward == pytest.approx(-float(costs), rel=1e-6)
        fast = state.pipeline_state.replace(qvel=still + 100.0)
        runaway = step(state.replace(pipeline_state=fast), still)  # all joints are charged, in all remaining steps
        assert runaway.metrics["runaway"] == runaway.metrics["limit_excess"] == 1
        worst = env.config.horizon * (float(runaway.metrics["distance"]) + weight)
        assert runaway.reward == pytest.approx(-worst, rel=1e-5)


def test_training_and_held_out_demonstrations_differ():
    training, held_out = training_and_held_out(mimic.env_config("planar4dof", demonstrations=FEW))
    assert (training.count, held_out.count) == (6, 2)
    assert not np.isin(held_out.goals, training.goals).any()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"previw": 1}, "unknown key 'previw'; valid are"),
        ({"preview": "x"}, "preview: expected a whole number, got 'x'"),
        ({"demonstrations": {"cont": 1}}, "unknown key 'demonstrations.cont'"),
        ({"limits": "soft"}, "expected one of none, hardware"),
        ({"demonstrations": {"kind": "dance"}}, "expected one of computed_torque, pid, reach, splines, steps, mixed"),
        ({"metric": {"rotation": -1.0}}, "metric.rotation: expected a number from 0 to 1e.06, got -1.0"),
        ({"learner": {"locked": [9]}}, "learner.locked: unknown joint 9"),
        ({"learner": 3}, "learner: expected an arm's name, its file or an ArmConfig, got 3"),
        ({"observation": [1]}, "expected the fields of ObservationConfig, got"),
    ],
)
def test_bad_overrides_are_rejected(overrides, message):
    with pytest.raises(ValueError, match=message):
        mimic.make("panda4dof", **overrides)


def test_a_critic_observes_where_the_expert_will_be():
    env = mimic.make("panda4dof", demonstrations=FEW)
    state = env.at_step(env.start(jax.random.PRNGKey(0), 1), jnp.asarray(45))
    positions = np.asarray(env.expert_states.position)[1, [48, 50, 50]]  # the last sample stays
    np.testing.assert_array_equal(
        env.privileged(state), np.concatenate([[45 / 50], positions.ravel()], dtype=np.float32)
    )
