"""Which checkpoint of PPO is the result."""

from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

import mimic
from mimic.runs.checkpoints import Checkpoint, checkpoint_steps
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo import brax_loop, ppo

WITHOUT_SCHEDULES: dict[str, Any] = {"final_learning_rate": 1.0, "final_entropy_cost": 1.0, "privileged_critic": False}


def run(monkeypatch, run_dir, values):
    """Trains where the parameter is one of `values` at each step; returns the result, its steps and those evaluated."""

    def checkpoints(*_):
        for step, value in enumerate(values):
            yield Checkpoint(step, {"x": np.array([value])}, [np.zeros(1)], {"loss": 0.0} if step else {})

    evaluated = []

    monkeypatch.setattr(ppo, "_checkpoints", checkpoints)
    config = PPOConfig(num_timesteps=len(values)).resolve("cpu")
    step, params = ppo.train(
        None,  # type: ignore[arg-type]
        config,
        run_dir,
        seed=0,
        on_evaluation=lambda step, *_: evaluated.append(step),
        signals=Signals(),
    )
    return step, float(jax.tree.leaves(params)[0][0]), evaluated


def test_the_last_checkpoint_is_the_result(monkeypatch, tmp_path):
    assert run(monkeypatch, tmp_path, [1.0, 2.0, 3.0, 4.0]) == (3, 4.0, [0, 1, 2, 3])


def test_the_checkpoints_of_braxs_loop_are_evaluated_and_saved_in_order(monkeypatch, tmp_path):
    def loop(*, policy_params_fn, progress_fn, num_evals, **_):
        policy_params_fn(0, None, {"x": np.array([0.0])})
        for epoch in range(1, num_evals):
            policy_params_fn(10 * epoch, None, {"x": np.array([float(epoch)])})
            progress_fn(10 * epoch, {"training/sps": 5.0, "training/v_loss": 1.0})

    monkeypatch.setattr(brax_loop.brax_ppo, "train", loop)
    evaluated, config = [], PPOConfig(loop="brax", evaluations=3, **WITHOUT_SCHEDULES).resolve("cpu")
    env: Any = SimpleNamespace(config=SimpleNamespace(horizon=5))

    def on_evaluation(step, _params, metrics):
        evaluated.append(step)
        assert metrics == ({"sps": 5.0, "v_loss": 1.0} if step else {})

    arguments: dict[str, Any] = {"seed": 0, "on_evaluation": on_evaluation, "signals": Signals()}
    step, params = brax_loop.train(env, config, tmp_path, **arguments)
    assert (step, float(params["x"][0]), evaluated) == (30, 3.0, [0, 10, 20, 30])
    assert checkpoint_steps(tmp_path)[-1] == step


@pytest.mark.slow
def test_braxs_loop_trains_on_the_same_environment(tmp_path):
    """Parameters of the same structure as those of mimic's loop, with a policy that is better than an untrained one."""
    few = {"num_timesteps": 40_000, "num_envs": 64, "batch_size": 32, "num_minibatches": 8, "crossovers": 0}
    trainer = {**few, **WITHOUT_SCHEDULES, "loop": "brax", "evaluations": 2, "unroll_length": 10}
    model = mimic.fit(
        "planar4dof", trainer=trainer, demonstrations={"count": 5, "held_out": 2}, run_dir=str(tmp_path / "run")
    )
    assert model.report["env_steps"] >= 40_000 and np.isfinite(model.report["optimality_gap"]["train"])
    assert model.report["steps_per_second"] > 0
