"""The search for torques: never worse than its start, and exact where learner and expert are equal."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from benchmarks.common.trajectory_descent import Task, TrajectoryDescent, _bounded_law
from benchmarks.searched_torques import main, search_torques
from mimic.envs.imitation import ImitationEnv, training_and_held_out
from mimic.evaluation.evaluator import Evaluator
from mimic.evaluation.labels import SPLITS
from mimic.physics.step import Load
from tests.helpers.untrained_run import untrained_run

HORIZON = 20
LINKS = [0.4, 0.3, 0.3]


def evaluator_of(learner, **settings):
    config = mimic.env_config(
        "planar4dof",
        expert={"link_lengths": LINKS},
        learner={"link_lengths": learner},
        demonstrations={"count": 2, "held_out": 1},
        horizon=HORIZON,
        **settings,
    )
    training, held_out = training_and_held_out(config)
    return Evaluator(ImitationEnv(config, training), held_out)


@pytest.fixture(scope="module")
def evaluator():
    return evaluator_of([0.5, 0.5])


def descent_and_task(evaluator, chunk=4_000):
    """Of the training demonstrations, without randomisation."""
    env = evaluator.env
    expert = jax.tree.map(lambda table: table[:, 1:], env.expert_states)
    loads = Load(*jnp.ones((2, env.demonstrations.count)))
    return TrajectoryDescent(env, chunk), Task(expert, loads, env.start_poses)


def random_actions(evaluator, size=0.2):
    shape = evaluator.env.demonstrations.count, HORIZON, evaluator.env.action_size
    return size * jax.random.normal(jax.random.PRNGKey(3), shape)


def controller_of(action):
    """A controller that plays the actions back."""
    return lambda state: action[state.pipeline_state.demonstration, state.pipeline_state.step]


@pytest.mark.slow
def test_an_arm_that_imitates_itself_finds_the_torques():
    """From zero torques. Both arms hold a torque for 0.1 s: 1e-3 of the hold distance is rounding and kinks."""
    evaluator = evaluator_of(LINKS, action_scale=2.0)
    still = lambda state: jnp.zeros(evaluator.env.action_size)  # noqa: E731
    best, _ = search_torques(evaluator, still, iterations=30, starts=1)
    np.testing.assert_array_less(np.mean(best.distance, axis=1), 1e-3 * evaluator.hold_distance.mean(axis=1))


@pytest.mark.slow
def test_no_update_makes_a_sequence_worse(evaluator):
    descent, task = descent_and_task(evaluator)
    episodes = descent.start(task, random_actions(evaluator))
    first = episodes.objective
    for _ in range(8):
        before, episodes = episodes.objective, descent.improve(task, episodes)
        assert np.all(np.asarray(episodes.objective) <= np.asarray(before))
        assert np.abs(episodes.action).max() <= 1
    assert np.all(np.asarray(episodes.objective) < 0.5 * np.asarray(first))


@pytest.mark.slow
def test_the_objective_equals_the_distance_in_the_environment(evaluator, capsys):
    """With the loads that the environment draws. 2e-5: float32, and the five digits of the text."""
    loaded = evaluator_of([0.5, 0.5], randomization={"mass": [0.5, 2.0], "damping": [0.5, 2.0]})
    objectives = []
    for each in (evaluator, loaded):
        controller = controller_of(random_actions(each))
        search_torques(each, controller, iterations=1, starts=1)
        first = capsys.readouterr().out.splitlines()[0]
        rolled_out = jax.jit(lambda each=each, controller=controller: each.rollout(controller))()
        objectives.append(float(first.rpartition("objective ")[2]))
        assert objectives[-1] == pytest.approx(float(np.mean(np.asarray(rolled_out.distance))), abs=2e-5)
    assert abs(objectives[0] - objectives[1]) > 1e-3


@pytest.mark.slow_for("arc_length-False")
@pytest.mark.parametrize(("correspondence", "adaptive"), [("arc_length", False), ("soft", True)])
def test_the_gradient_is_that_of_the_objective(correspondence, adaptive):
    """By single actions, over a whole rollout, against central differences.

    2e-3 of the maximum: a float32 objective, 1e-7, over a step of 2e-3, and its third derivative.
    """
    metric = {"adaptive": adaptive, "correspondence": correspondence, "linear_velocity": 0.1, "angular_velocity": 0.1}
    evaluator = evaluator_of([0.5, 0.5], metric=metric)
    descent, task = descent_and_task(evaluator)
    action = random_actions(evaluator)
    episodes = descent.start(task, action)
    model = jax.vmap(descent._linearized)(task, episodes)

    def objective_slope(model):
        def back(slope, at):
            slope = slope + at.gradient
            return at.by_state.T @ slope, at.by_action.T @ slope

        return jax.lax.scan(back, jnp.zeros(4), model, reverse=True)[1] / HORIZON

    slope = np.asarray(jax.vmap(objective_slope)(model))
    for step, joint in ((0, 0), (7, 1), (HORIZON - 1, 0)):
        moved = [descent.start(task, action.at[:, step, joint].add(sign * 2e-3)).objective for sign in (1, -1)]
        difference = (np.asarray(moved[0], float) - np.asarray(moved[1], float)) / 4e-3
        np.testing.assert_allclose(slope[:, step, joint], difference, atol=2e-3 * np.abs(slope).max())


@pytest.mark.slow
def test_updates_do_not_depend_on_how_many_sequences_are_differentiated_at_a_time(evaluator):
    """Three sequences, two at a time; the last round is filled up. 1e-4: float32, and a linear solve."""
    whole, parts = (
        descent.improve(task, descent.start(task, random_actions(evaluator)))
        for descent, task in (descent_and_task(evaluator, chunk) for chunk in (4_000, 2 * HORIZON))
    )
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


def test_the_curvature_is_positive(evaluator):
    descent, task = descent_and_task(evaluator)
    model = jax.vmap(descent._linearized)(task, descent.start(task, random_actions(evaluator)))
    values = np.linalg.eigvalsh(np.asarray(model.curvature, float))
    assert values.min() > -1e-6 * values.max()  # float32 products


def test_a_bounded_law_is_the_minimum_between_the_bounds():
    """Against converged projected gradient descent. 1e-5: float32."""
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    root = jax.random.normal(keys[0], (3, 3))
    matrix, gradient, mixed = root @ root.T + jnp.eye(3), 3 * jax.random.normal(keys[1], (3,)), jnp.ones((3, 2))
    lower, upper = jnp.full(3, -0.3), jnp.full(3, 0.4)
    change, gain = _bounded_law(matrix, gradient, mixed, lower, upper)
    best = jnp.zeros(3)
    for _ in range(2000):
        best = jnp.clip(best - 0.05 * (matrix @ best + gradient), lower, upper)
    np.testing.assert_allclose(change, best, atol=1e-5)
    at_bound = np.isclose(change, lower) | np.isclose(change, upper)
    assert 0 < at_bound.sum() < 3
    np.testing.assert_array_equal(np.asarray(gain)[at_bound], 0)
    np.testing.assert_array_equal(np.all(np.asarray(gain)[~at_bound] != 0, axis=1), True)


def test_runaways_give_no_nan(evaluator):
    """With a speed bound that the maximum torques exceed in one step and zero torques do not."""
    slow = evaluator_of([0.5, 0.5], speed_bound=1.0)
    descent, task = descent_and_task(slow)
    greedy = jnp.ones_like(random_actions(slow)).at[0].set(0.0)
    episodes = descent.improve(task, descent.start(task, greedy))
    assert np.isfinite(np.asarray(episodes.objective)[0])
    assert not np.isnan(np.asarray(episodes.objective)).any()
    assert np.abs(np.asarray(episodes.qvel)[0]).max() < 1.0


@pytest.mark.slow
def test_the_best_of_all_starts_is_returned(tmp_path, monkeypatch, capsys):
    """Of an untrained policy. 1e-5: float32, means in another order."""
    run, out = untrained_run(tmp_path / "run"), tmp_path / "out.json"
    arguments = ["--run", str(run), "--iterations", "5", "--starts", "5", "--out", str(out), "--commit", "none"]
    monkeypatch.setattr(sys, "argv", ["searched_torques", *arguments])
    main()
    result = json.loads(out.read_text())
    assert list(result["starts"]) == ["policy", "computed_torque", "pd", "hold", "noisy_policy_1"]
    for split in SPLITS:
        every = [gaps[kind][split] for gaps in result["starts"].values() for kind in ("start", "found")]
        assert result["optimality_gap"][split] <= min(every) + 1e-5
        for gaps in result["starts"].values():
            assert gaps["found"][split] < gaps["start"][split]
