"""Which checkpoint of PPO is the result: the last one, or that with the smallest score."""

from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from mimic.runs.checkpoints import Checkpoint, checkpoint_steps, load_checkpoint
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOConfig
from mimic.trainers.ppo import ppo
from mimic.trainers.ppo.trainer import PPOTrainer


def run(monkeypatch, run_dir, values, restored=None, score=lambda params: float(params["x"][0]), last=None, **settings):
    """Trains where the parameter is one of `values` at each step; returns the result, its steps and those evaluated."""

    def checkpoints(_env, _config, _seed, restored, *_):
        first = restored.step if restored else 0
        for step in range(first, len(values)):
            yield Checkpoint(step, {"x": np.array([values[step]])}, [np.zeros(1)], {"loss": 0.0} if step else {})

    evaluated = []

    def on_evaluation(step, _params, _metrics):
        evaluated.append(step)
        return step == last

    monkeypatch.setattr(ppo, "_checkpoints", checkpoints)
    config = PPOConfig(num_timesteps=len(values), **settings).resolve("cpu")
    step, params = ppo.train(
        None,  # type: ignore[arg-type]
        config,
        run_dir,
        seed=0,
        on_evaluation=on_evaluation,
        signals=Signals(),
        restored=restored,
        score=score,
    )
    return step, float(jax.tree.leaves(params)[0][0]), evaluated


@pytest.mark.parametrize(
    ("values", "best"),
    [
        ([3.0, 2.0, 1.0], 2),
        ([1.0, 2.0, 3.0], 0),
        ([2.0, 1.0, 3.0, 1.0], 1),
        ([1.0, np.nan, 2.0], 0),
        ([np.nan, 2.0], 1),
    ],
)
def test_the_result_has_the_smallest_score(monkeypatch, tmp_path, values, best):
    assert run(monkeypatch, tmp_path, values) == (best, values[best], list(range(len(values))))


def test_without_a_score_the_last_checkpoint_is_the_result(monkeypatch, tmp_path):
    assert run(monkeypatch, tmp_path, [1.0, 2.0, 3.0], score=None)[:2] == (2, 3.0)


def test_a_target_that_is_reached_ends_the_training_with_the_checkpoint_that_reached_it(monkeypatch, tmp_path):
    assert run(monkeypatch, tmp_path, [1.0, 2.0, 3.0, 4.0], last=2) == (2, 3.0, [0, 1, 2])


def test_a_damaged_checkpoint_is_not_the_result(monkeypatch, tmp_path, capsys):
    values = [2.0, 1.0, 3.0]
    run(monkeypatch, tmp_path, values)
    (tmp_path / "checkpoints" / f"{1:012d}" / "checkpoint.json").write_text("{")
    restored = Checkpoint(2, {"x": np.array([3.0])}, None, {"loss": 0.0})
    assert run(monkeypatch, tmp_path, values, restored)[:2] == (0, 2.0)
    assert "it cannot be the result" in capsys.readouterr().err


def test_the_best_checkpoint_is_kept(monkeypatch, tmp_path):
    assert run(monkeypatch, tmp_path, [2.0, 1.0, 3.0, 4.0, 5.0, 6.0], keep=2)[0] == 1
    assert checkpoint_steps(tmp_path) == [1, 4, 5]


def test_a_resumed_run_knows_the_checkpoints_before(monkeypatch, tmp_path):
    values = [2.0, 1.0, 3.0, 4.0]
    run(monkeypatch, tmp_path, values[:3])
    step, params = load_checkpoint(tmp_path, {"x": np.zeros(1)})
    restored = Checkpoint(step, params, None, {"loss": 0.0})
    assert step == 2 and run(monkeypatch, tmp_path, values, restored) == (1, 1.0, [2, 3])


@pytest.mark.parametrize(("train", "held_out", "is_good"), [(0.1, 0.3, True), (0.2, 0.05, False)])
def test_the_target_is_the_gap_of_the_training_demonstrations(train, held_out, is_good):
    trainer: Any = SimpleNamespace(settings=PPOConfig(target_gap=0.1))
    assert PPOTrainer.good_enough(trainer, {"optimality_gap": {"train": train, "held_out": held_out}}) == is_good
