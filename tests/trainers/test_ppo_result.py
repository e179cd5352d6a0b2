"""Which checkpoint of PPO is the result."""

from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from mimic.runs.checkpoints import Checkpoint
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo import ppo
from mimic.trainers.ppo.trainer import PPOTrainer


def run(monkeypatch, run_dir, values, last=None):
    """Trains where the parameter is one of `values` at each step; returns the result, its steps and those evaluated."""

    def checkpoints(*_):
        for step, value in enumerate(values):
            yield Checkpoint(step, {"x": np.array([value])}, [np.zeros(1)], {"loss": 0.0} if step else {})

    evaluated = []

    def on_evaluation(step, _params, _metrics):
        evaluated.append(step)
        return step == last

    monkeypatch.setattr(ppo, "_checkpoints", checkpoints)
    config = PPOConfig(num_timesteps=len(values)).resolve("cpu")
    step, params = ppo.train(
        None,  # type: ignore[arg-type]
        config,
        run_dir,
        seed=0,
        on_evaluation=on_evaluation,
        signals=Signals(),
    )
    return step, float(jax.tree.leaves(params)[0][0]), evaluated


def test_the_last_checkpoint_is_the_result(monkeypatch, tmp_path):
    assert run(monkeypatch, tmp_path, [1.0, 2.0, 3.0]) == (2, 3.0, [0, 1, 2])


def test_a_target_that_is_reached_ends_the_training_with_the_checkpoint_that_reached_it(monkeypatch, tmp_path):
    assert run(monkeypatch, tmp_path, [1.0, 2.0, 3.0, 4.0], last=2) == (2, 3.0, [0, 1, 2])


@pytest.mark.parametrize(("train", "held_out", "is_good"), [(0.1, 0.3, True), (0.2, 0.05, False)])
def test_the_target_is_the_gap_of_the_training_demonstrations(train, held_out, is_good):
    trainer: Any = SimpleNamespace(settings=PPOConfig(target_gap=0.1))
    assert PPOTrainer.good_enough(trainer, {"optimality_gap": {"train": train, "held_out": held_out}}) == is_good
