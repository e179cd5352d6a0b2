"""`mimic.fit`: a training from Python, and the run that it returns."""

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.envs.imitation import training_and_held_out
from tests.helpers.run_directories import write_run

SMALL = {"physics": "fused", "horizon": 5, "demonstrations": {"count": 2, "held_out": 1}}
TRAINER = {
    "num_timesteps": 1000,
    "num_envs": 16,
    "unroll_length": 5,
    "batch_size": 8,
    "num_minibatches": 2,
    "num_updates_per_batch": 1,
    "hidden_layers": [8],
    "evaluations": 2,
}


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A run, and the environment that it was trained in."""
    env = mimic.make("planar4dof", **SMALL)
    return mimic.fit(env, trainer=TRAINER, seed=3, run_dir=str(tmp_path_factory.mktemp("fit") / "run"), quiet=True), env


@pytest.mark.slow
def test_a_run_has_report_policy_and_plots(fitted, capsys):
    run, env = fitted
    assert capsys.readouterr().out == ""  # quiet
    assert run.report == json.loads((run.run_dir / "report.json").read_text())
    assert run.report["seed"] == 3 and run.report["env_steps"] >= 1000
    assert {"quality", "similarity", "training"} <= set(run.plots) and run.plots["quality"].width > 100
    observation = env.reset(jax.random.PRNGKey(0)).obs
    action = run.policy(observation)
    assert action.shape == (4,) and jnp.abs(action).max() <= 1
    batch = jax.vmap(run.policy)(jnp.stack([observation, 2 * observation]))
    np.testing.assert_allclose(batch[0], action, atol=1e-5)  # float32
    np.testing.assert_array_equal(run.make_env().demonstrations.qpos, env.demonstrations.qpos)


@pytest.mark.slow
def test_a_run_is_evaluated_and_opened_again(fitted, capsys):
    run, _ = fitted
    report = mimic.Run(run.run_dir).evaluate(quiet=True)
    assert report["mean_distance"] == pytest.approx(run.report["mean_distance"], rel=1e-5)
    assert capsys.readouterr().out == ""
    with pytest.raises(ValueError, match="evaluate: unknown key 'masses'"):
        run.evaluate(masses=1.2)


def test_a_run_without_a_report_is_one_line(tmp_path):
    run_dir = write_run(tmp_path / "run", [0.5], report=False)
    with pytest.raises(ValueError, match="report.json' cannot be read"):
        _ = mimic.Run(run_dir).report


class Renamed(mimic.ImitationEnv):
    """A class that is not registered."""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env": "panda5dof"}, "unknown environment 'panda5dof'"),
        ({"trainer": "sac"}, "trainer: expected one of ppo, pose_mapper, got 'sac'"),
        ({"trainer": {"num_steps": 3}}, "trainer: unknown key 'num_steps'; valid are .*num_timesteps"),
        ({"horizon": 0}, "horizon: expected"),
        ({"seed": 2**80}, "seed: expected"),
        ({"env": lambda: mimic.env_config("planar4dof"), "horizon": 5}, "horizon: expected the name of an environment"),
        ({"env": lambda: Renamed(mimic.env_config("planar4dof", **SMALL))}, "register the class"),
    ],
)
def test_a_bad_training_is_one_line_and_writes_nothing(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    values: dict[str, Any] = {key: value() if callable(value) else value for key, value in arguments.items()}
    with pytest.raises(ValueError, match=message):
        mimic.fit(**values)
    assert not list(tmp_path.iterdir())


def test_other_demonstrations_than_those_of_the_config_are_rejected(tmp_path):
    env = mimic.make("planar4dof", **SMALL)
    other = env.with_demonstrations(training_and_held_out(env.config)[1])
    with pytest.raises(ValueError, match="expected the demonstrations of its config, got others"):
        mimic.fit(other, trainer=TRAINER, run_dir=str(tmp_path / "run"))
    assert not (tmp_path / "run").exists()
