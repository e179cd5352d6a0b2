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


def descent_and_task(evaluator):
    """Of the training demonstrations, without randomisation."""
    env = evaluator.env
    expert = jax.tree.map(lambda table: table[:, 1:], env.expert_states)
    loads = Load(*jnp.ones((2, env.demonstrations.count)))
    return TrajectoryDescent(env, 4_000), Task(expert, loads, env.start_poses)


def random_actions(evaluator):
    shape = evaluator.env.demonstrations.count, HORIZON, evaluator.env.action_size
    return 0.2 * jax.random.normal(jax.random.PRNGKey(3), shape)


@pytest.mark.slow
def test_an_arm_that_imitates_itself_finds_the_torques():
    """From zero torques. Both arms hold a torque for 0.1 s: 1e-3 of the hold distance is rounding and kinks."""
    evaluator = evaluator_of(LINKS, action_scale=2.0)
    still = lambda state: jnp.zeros(evaluator.env.action_size)  # noqa: E731
    best, _ = search_torques(evaluator, still, iterations=30, starts=1)
    np.testing.assert_array_less(np.mean(best.distance, axis=1), 1e-3 * evaluator.hold_distance.mean(axis=1))


@pytest.mark.slow
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


def test_a_bounded_law_is_the_minimum_between_the_bounds():
    """Against converged projected gradient descent. 1e-5: float32."""
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    root = jax.random.normal(keys[0], (3, 3))
    matrix, gradient, mixed = root @ root.T + jnp.eye(3), 3 * jax.random.normal(keys[1], (3,)), jnp.ones((3, 2))
    lower, upper = jnp.full(3, -0.3), jnp.full(3, 0.4)
    change, gain = jax.jit(_bounded_law)(matrix, gradient, mixed, lower, upper)
    best = np.zeros(3)
    for _ in range(2000):
        best = np.clip(best - 0.05 * (np.asarray(matrix) @ best + np.asarray(gradient)), lower, upper)
    np.testing.assert_allclose(change, best, atol=1e-5)
    at_bound = np.isclose(change, lower) | np.isclose(change, upper)
    assert 0 < at_bound.sum() < 3
    np.testing.assert_array_equal(np.asarray(gain)[at_bound], 0)
    np.testing.assert_array_equal(np.all(np.asarray(gain)[~at_bound] != 0, axis=1), True)


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
