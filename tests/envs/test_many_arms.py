"""The environment of any arm, and the controller of one arm that it contains."""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.arms.arm import ArmConfig, build_arm
from mimic.arms.arrays import MAX_JOINTS, arm_arrays, lock_joints, stack_arms
from mimic.arms.sampler import lock_masks, lock_sampler, random_arm
from mimic.envs.imitation import training_and_held_out
from mimic.envs.many_arms import AnyArmEnv, any_arm_state
from mimic.envs.wrappers import fresh_episodes
from mimic.evaluation.evaluator import Evaluator
from mimic.evaluation.nearest_pose_controller import nearest_pose_controller
from mimic.evaluation.tracking_controllers import run_controller
from mimic.metric.kinematics import link_states

HORIZON, COUNT, HELD_OUT = 20, 3, 2  # 2 s


@pytest.fixture(scope="module")
def config():
    return mimic.env_config(
        "panda4dof",
        physics="fused",
        horizon=HORIZON,
        demonstrations={"count": COUNT, "held_out": HELD_OUT},
        arms={"random_fraction": 1.0},
        metric={"hand_rotation": 0.0},
    )


@pytest.fixture(scope="module")
def motions(config):
    return training_and_held_out(config)


@pytest.fixture(scope="module")
def panda():
    return arm_arrays(build_arm(ArmConfig()))


@pytest.fixture(scope="module")
def env(config, motions):
    return AnyArmEnv(config, motions[0], random_arm).by_distance()


@pytest.fixture(scope="module")
def four_joints(panda):
    mask = np.isin(np.arange(MAX_JOINTS), (2, 5, 6)).astype(float)
    return jax.tree.map(jnp.asarray, lock_joints(panda, mask).astype(np.float32))


@pytest.fixture(scope="module")
def zero_actions(env, four_joints):
    """Rollouts of the zero action on each demonstration: states over time."""

    def run(demonstration):
        start = env.begin(env.start_of(four_joints, demonstration, jax.random.PRNGKey(0)))

        def step(state, _):
            state = env.step(state, jnp.zeros(env.action_size))
            return state, state

        return jax.lax.scan(step, start, None, length=HORIZON)[1]

    return jax.jit(jax.vmap(run))(jnp.arange(COUNT))


@pytest.fixture(scope="module")
def evaluator(config, motions):
    return Evaluator(mimic.ImitationEnv(dataclasses.replace(config, arms=None), motions[0]), motions[1])


@pytest.mark.slow
def test_the_controller_is_near_the_kinematic_bound(evaluator):
    """Measured: 0.6 and 1.2 % in the first two seconds; in whole episodes of the default demonstrations less."""
    gap = evaluator.summary(run_controller(evaluator, "nearest_pose")[0])["optimality_gap"]
    assert -0.001 < gap["train"] < 0.02 and -0.001 < gap["held_out"] < 0.02


def test_the_controller_rejects_what_arrays_do_not_cover():
    metric = {"correspondence": "hard"}
    small = {"demonstrations": {"count": 1, "held_out": 1}, "horizon": 5, "physics": "fused"}
    with pytest.raises(ValueError, match="metric: expected the default one.*got correspondence=hard"):
        nearest_pose_controller(mimic.make("panda4dof", metric=metric, **small))
    tree = mimic.make("bimanual", **small)
    with pytest.raises(ValueError, match="expected a serial arm, got a tree of 2 chains"):
        nearest_pose_controller(tree)


@pytest.fixture(scope="module")
def compared(config, motions):
    """An environment whose reward compares with the zero action."""
    return AnyArmEnv(config, motions[0], random_arm)


@pytest.mark.slow
def test_a_relative_reward_compares_with_the_zero_action(compared, four_joints, zero_actions):
    """The zero action itself has no reward; others have that of their distance and of that of `zero_actions`."""
    step, still = jax.jit(compared.step), jnp.zeros(compared.action_size)
    start = compared.begin(compared.start_of(four_joints, 0, jax.random.PRNGKey(0)))
    at_rest = step(step(start, still), still)
    assert float(at_rest.reward) == pytest.approx(0, abs=1e-6)
    state, size = start, 0.0
    for index in range(3):
        before, state = any_arm_state(state), step(state, 0.3 * jnp.ones(compared.action_size))
        own, baseline = state.metrics["distance"], zero_actions.metrics["distance"][0, index]
        expert, metric = compared.expert_at(jnp.asarray(0), jnp.asarray(index + 1)), compared.metric_of(four_joints)
        assert before.baseline is not None
        goals = [before.goals.goal, before.baseline.goals.goal]
        nearest = min(metric(expert, link_states(four_joints, goal.qpos, goal.qvel)) for goal in goals)
        excess = [max(float(x - nearest), 0.0) / float(before.hold) + 0.01 for x in (own, baseline)]
        assert float(state.reward) == pytest.approx(np.log(excess[1] / excess[0]), abs=1e-3)
        size = max(size, abs(float(state.reward)))
    assert size > 0.01


@pytest.mark.slow
def test_a_baseline_that_ran_away_leaves_the_reward_finite(compared, four_joints):
    start = compared.start_of(four_joints, 0, jax.random.PRNGKey(0))
    assert start.baseline is not None
    lost = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), start.baseline.goals)
    start = dataclasses.replace(start, baseline=dataclasses.replace(start.baseline, goals=lost))
    assert np.isfinite(jax.jit(compared._nearest)(start))


@pytest.mark.slow
def test_observations_have_their_size_and_are_bounded(env, zero_actions):
    observation = np.asarray(zero_actions.obs)
    assert observation.shape == (COUNT, HORIZON, env.observation_size)
    assert np.isfinite(observation).all() and np.abs(observation).max() <= 10


def test_a_runaway_ends_and_is_charged_for_all_remaining_steps(env, four_joints, monkeypatch):
    """The reward is minus the distance in units of holding. Without plans, which take long to compile."""
    monkeypatch.setattr(AnyArmEnv, "_planned", lambda env, state: state)

    @jax.jit
    def step(qvel):
        start = env.start_of(four_joints, 0, jax.random.PRNGKey(0))
        return env.step(env.begin(start.replace(qvel=qvel)), jnp.zeros(env.action_size))

    at_rest, fast = step(jnp.zeros(MAX_JOINTS)), step(jnp.full(MAX_JOINTS, 1e4) * four_joints.is_free)
    distance, hold = at_rest.metrics["distance"], any_arm_state(at_rest).hold
    assert not at_rest.done and at_rest.reward == pytest.approx(-float(distance / hold), rel=1e-6)
    assert at_rest.obs.shape == (env.observation_size,)
    assert fast.done == 1 and fast.metrics["runaway"] == 1
    assert float(fast.reward) == pytest.approx(-3 * HORIZON)


@pytest.mark.slow
def test_each_episode_has_a_new_arm(config, motions, panda):
    """In a batch, from random steps on, as in training."""
    masks = lock_masks(7, 1)
    env = AnyArmEnv(config, motions[0], lock_sampler(panda, masks)).by_distance()
    wrapped = fresh_episodes(cast(Any, env))
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(1), 8))
    step = jax.jit(wrapped.step)
    drawn, steps = [np.asarray(any_arm_state(state).arm.is_free)], np.asarray(any_arm_state(state).step)
    assert len(np.unique(steps)) > 3
    for _ in range(HORIZON):
        before, was_free = any_arm_state(state), drawn[-1]
        state = step(state, jnp.zeros((8, env.action_size)))
        drawn.append(np.asarray(any_arm_state(state).arm.is_free))
        restarted = np.asarray(state.done) > 0
        np.testing.assert_array_equal(restarted, np.asarray(before.step) + 1 == HORIZON)
        np.testing.assert_array_equal(drawn[-1][~restarted], was_free[~restarted])
        assert not np.asarray(any_arm_state(state).qpos)[restarted].any()
    assert len(np.unique(np.concatenate(drawn), axis=0)) > 3
    np.testing.assert_array_equal(stack_arms([panda]).is_free[0], panda.is_free)


@pytest.mark.slow
def test_actions_change_the_acceleration(env, four_joints):
    """By two velocity limits per control step and unit of the action, half of it as angle; locked joints stay."""
    state = env.begin(env.start_of(four_joints, 0, jax.random.PRNGKey(0)))
    step, size = jax.jit(env.step), 0.05
    still = any_arm_state(step(state, jnp.zeros(env.action_size))).qpos
    actions = size * jnp.eye(MAX_JOINTS, env.action_size)
    moved = np.stack([any_arm_state(step(state, action)).qpos - still for action in actions])
    free = [0, 1, 3, 4]
    expected = size * 0.1 * np.asarray(four_joints.velocity_limit)
    # The inertia at the middle of the step is that of the whole step to some per cent.
    np.testing.assert_allclose(np.diagonal(moved)[free], expected[free], rtol=0.1)
    assert not np.delete(moved, free, axis=0).any()


@pytest.mark.slow
def test_a_policy_moves_one_arm_as_it_moves_it_among_many(env, evaluator, four_joints):
    """Two implementations of all: arrays with locked joints, which keep their places, and the compiled-in arm.

    The policy is a random linear function of the observation. 1e-3 rad: float32 in 20 steps of a controller that
    amplifies nothing.
    """
    weights = 0.1 * jax.random.normal(jax.random.PRNGKey(3), (env.action_size, env.observation_size))

    def policy(observation):
        return jnp.tanh(weights @ observation)

    def run(demonstration):
        key = jax.random.fold_in(jax.random.PRNGKey(0), demonstration)  # of random poses, as in `Evaluator.rollout`
        key = evaluator.env.start(key, demonstration).key
        start = env.begin(env.start_of(four_joints, demonstration, key))

        def step(state, _):
            state = env.step(state, policy(state.obs))
            return state, (any_arm_state(state).qpos, state.metrics["distance"])

        return jax.lax.scan(step, start, None, length=HORIZON)[1]

    qpos, distance = (np.asarray(x) for x in jax.jit(jax.vmap(run))(jnp.arange(COUNT)))
    controller = nearest_pose_controller(evaluator.env, policy)
    alone = jax.jit(lambda: evaluator.rollout(controller))()
    assert np.abs(qpos).max() > 0.1 and not qpos[:, :, [2, 5, 6, 7]].any()
    np.testing.assert_allclose(qpos[:, :, [0, 1, 3, 4]], np.asarray(alone.qpos)[:COUNT], rtol=0, atol=1e-3)
    np.testing.assert_allclose(distance, np.asarray(alone.distance)[:COUNT], rtol=0, atol=1e-4)


@pytest.mark.slow
def test_arms_that_are_not_done_go_on_as_without_a_restart(env, zero_actions):
    """Training restarts in each step the arms that are done; the others must be those of an evaluation."""
    some = jax.tree.map(lambda x: x[:, 3], zero_actions)
    after = jax.jit(env.restart_done)(some)
    before, now = any_arm_state(some), any_arm_state(after)
    np.testing.assert_allclose(after.obs, some.obs, atol=1e-4)
    np.testing.assert_allclose(now.goals.goal.qpos, before.goals.goal.qpos, atol=1e-4)
    np.testing.assert_allclose(now.goals.others, before.goals.others, atol=1e-4)


@pytest.mark.slow
def test_observations_know_nothing_of_the_expert_after_the_next_step(env, four_joints):
    def observed(env):
        start = env.at_step(env.start_of(four_joints, 0, jax.random.PRNGKey(0)), 5)
        return env.observe(start), env.command(start, jnp.zeros(env.action_size))

    later = jax.tree.map(lambda x: x.at[:, 7:].add(1.0), env.expert_states)
    next_step = jax.tree.map(lambda x: x.at[:, 6].add(1.0), env.expert_states)
    own, with_later, with_next = (
        jax.jit(lambda env=env: observed(env))()
        for env in (env, env.with_expert_states(later), env.with_expert_states(next_step))
    )
    for a, b in zip(own, with_later, strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.abs(own[0] - with_next[0]).max() > 0.1
