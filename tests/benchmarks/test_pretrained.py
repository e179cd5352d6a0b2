"""`python -m benchmarks.pretrained`: run directories become the networks that come with mimic."""

import json
import shlex

import numpy as np
import pytest

from benchmarks import pretrained
from mimic.base.files import read_json
from mimic.envs import env_config
from mimic.runs.files import REPORT
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.pretrained import NETWORKS
from mimic.trainers.pretrained.network import read_network
from mimic.trainers.run_config import load_config
from tests.helpers import pages
from tests.helpers.untrained_run import untrained_run


def test_the_command_names_what_differs_from_the_defaults():
    trainer = PPOConfig(preset="cpu", num_timesteps=1000, hidden_layers=[8])
    config = TrainConfig(env_config("planar4dof", physics="fused"), trainer, seed=3, run_dir="runs/x")
    assert shlex.split(pretrained.training_command(config.resolve())) == [
        *("python", "-m", "mimic.train", "env=planar4dof", "trainer=ppo", "trainer.preset=cpu"),
        *("env.physics=fused", "trainer.num_timesteps=1000", "trainer.hidden_layers=[8]", "seed=3"),
    ]


FOLDERS = sorted(NETWORKS.iterdir())


@pytest.mark.slow_for(*(folder.name for folder in FOLDERS if not folder.name.startswith("planar4dof")))
@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_recorded_commands_are_valid(folder, monkeypatch):
    pages.check(shlex.split(read_json(folder / REPORT)["source"]["command"]), monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("half", [False, True])
def test_a_policy_is_measured_as_it_is_stored(tmp_path, half):
    run_dir = untrained_run(tmp_path / "run")
    (run_dir / REPORT).write_text(json.dumps({"env": "planar4dof", "seed": 0, "optimality_gap": {"held_out": 7.0}}))
    pretrained.make_network(run_dir, tmp_path / "out", "c0ffee", half)
    policy = read_network(tmp_path / "out" / "planar4dof-policy", "policy")
    assert policy.report["optimality_gap"] != {"held_out": 7.0}
    assert policy.source["commit"] == "c0ffee" and policy.source["matrices"] == ("float16" if half else "float32")
    assert policy.config.env == load_config(run_dir).env
    assert policy(np.zeros(policy.env.observation_size)).shape == (2,)
