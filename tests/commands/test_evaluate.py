"""`python -m mimic.evaluate`: controllers on demonstrations, and what it rejects."""

import collections
import csv
import dataclasses
import json
import re
import shutil

import numpy as np
import pytest

from mimic.commands.config import EvaluateConfig
from mimic.commands.evaluate import prepare_evaluation
from mimic.envs import imitation
from mimic.envs.config import DemonstrationConfig
from mimic.envs.imitation import training_and_held_out
from mimic.evaluation import references
from mimic.motions.experts import KINDS
from mimic.physics import step as physics
from mimic.runs.checkpoints import save_checkpoint
from mimic.runs.signals import Signals
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.make import make_trainer
from mimic.trainers.ppo import ppo
from mimic.trainers.ppo.trainer import PPOTrainer
from tests.helpers.run_directories import write_run
from tests.helpers.untrained_run import COUNT, HELD_OUT, HORIZON, environment, untrained_run


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return untrained_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="module")
def unseen():
    """Motions of the expert that are not in the run."""
    config = environment()
    fresh = dataclasses.replace(config.demonstrations, seed=7)
    return training_and_held_out(dataclasses.replace(config, demonstrations=fresh))[1]


def evaluate(run_dir, out, **settings):
    config = EvaluateConfig(str(run_dir), out=str(out), compilation_cache="", **settings)
    prepare_evaluation(config, 0.0)()
    with (out / "demonstrations.csv").open(newline="") as file:
        return json.loads((out / "report.json").read_text()), list(csv.DictReader(file))


@pytest.mark.slow
def test_holding_the_start_pose_has_a_gap_of_one(run_dir, tmp_path, monkeypatch):
    """Whatever the bound. 1e-5: float32, once from rollouts and once from the home pose."""
    bound = np.zeros((COUNT + HELD_OUT, HORIZON)), np.zeros((COUNT + HELD_OUT, HORIZON, 2))
    monkeypatch.setattr(references, "_lower_bound", lambda *_: bound)
    report, rows = evaluate(run_dir, tmp_path / "new", controller="hold", physics="fused")
    assert report["physics"] == "fused" and "mjx" not in report
    assert report["trainer"] == "hold"
    assert report["optimality_gap"] == pytest.approx({"train": 1, "held_out": 1}, abs=1e-5)
    assert [float(row["optimality_gap"]) for row in rows] == pytest.approx([1] * 6, abs=1e-5)
    assert report["torque_rms"] == {"train": 0, "held_out": 0}
    names = {path.name for path in (tmp_path / "new").iterdir()}
    assert names == {
        "config.yaml",
        "report.json",
        "demonstrations.csv",
        "quality.csv",
        "quality.png",
        "demonstrations.png",
        "similarity.png",
    }


@pytest.mark.slow
def test_a_policy_is_evaluated_on_mjx_too(run_dir, tmp_path, monkeypatch, capsys):
    """Where MJX does not move the arm at all, its distance is that of holding the start pose."""

    def at_rest(*_):
        return lambda qpos, qvel, torque: (qpos, qvel)

    monkeypatch.setattr(physics, "_mjx_advance", at_rest)
    report, _ = evaluate(run_dir, tmp_path / "new")
    shown = capsys.readouterr().out
    assert report["physics"] == "fused" and report["optimality_gap"] != pytest.approx({"train": 1, "held_out": 1})
    assert report["mjx"]["optimality_gap"] == pytest.approx({"train": 1, "held_out": 1}, abs=1e-5)
    assert report["mjx"]["mean_distance"] == pytest.approx(report["hold_distance"], rel=1e-5)
    assert re.search(r"evaluated on MJX +. +100.00% . +100.00%", shown)
    assert "mjx" not in evaluate(run_dir, tmp_path / "hold", controller="hold")[0]


@pytest.mark.slow
def test_other_demonstrations_replace_the_held_out_ones(run_dir, unseen, tmp_path):
    """Episodes have their length."""
    unseen.of_length(HORIZON + 5).save(tmp_path / "unseen.npz")  # more steps than the run's demonstrations have
    overrides = {"demonstrations": str(tmp_path / "unseen.npz"), "physics": "fused"}
    plain, rows = evaluate(run_dir, tmp_path / "plain", **overrides)
    numbers = [(row["split"], int(row["demonstration"])) for row in rows]
    assert numbers == [*(("train", i) for i in range(COUNT)), *(("held_out", i) for i in range(unseen.count))]
    assert "mjx" not in plain
    with (tmp_path / "plain" / "quality.csv").open(newline="") as file:
        times = [float(row["time"]) for row in csv.DictReader(file) if row["split"] == "held_out"]
    assert len(times) == HORIZON + 5


def test_the_test_set_has_the_same_number_of_each_kind(monkeypatch):
    monkeypatch.setattr(imitation, "TEST_COUNT", 1)
    unseen = imitation.test_demonstrations(environment())
    assert collections.Counter(unseen.kinds) == dict.fromkeys(KINDS, imitation.TEST_SETS)
    given = dataclasses.replace(environment(), demonstrations=DemonstrationConfig(path="motions.npz"))
    with pytest.raises(ValueError, match="split: expected none where the demonstrations are those of 'motions.npz'"):
        imitation.test_demonstrations(given)


def test_crossovers_are_trained_on_and_not_evaluated(monkeypatch, tmp_path):
    trained = []
    monkeypatch.setattr(ppo, "train", lambda env, *_, **__: trained.append(env))
    trainer = PPOConfig(hidden_layers=[8], preset="cpu", crossovers=3)
    job = make_trainer(TrainConfig(environment(), trainer), None)
    assert isinstance(job, PPOTrainer)
    job.train(tmp_path, lambda *_: None, Signals(), None)
    (env,) = trained
    assert env.demonstrations.count == COUNT + 3
    assert job.evaluator.parts["train"] == slice(0, COUNT)
    np.testing.assert_array_equal(env.demonstrations.qpos[:COUNT], job.evaluator.env.demonstrations.qpos[:COUNT])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["controller=lqr"],
            "controller: expected one of policy, hold, copy_joints, pd, computed_torque, one_step, nearest_pose, "
            "mpc, tracking, got 'lqr'",
        ),
        (["physics=bullet"], "physics: expected one of mjx, fused, got 'bullet'"),
        (["split=validation"], "split: expected one of test, got 'validation'"),
        (["split=test", "demonstrations=x.npz"], "split, demonstrations, robot: expected one of them, got several"),
        (["checkpoint=7"], "checkpoint: expected one of 0, the steps that"),
    ],
)
def test_bad_evaluations(reason, run_dir, arguments, message):
    assert message in reason("evaluate", f"run={run_dir}", "compilation_cache=", *arguments)


def test_unfit_demonstrations(reason, run_dir, unseen, tmp_path):
    dataclasses.replace(unseen, arm="panda").save(tmp_path / "unfit.npz")
    arguments = [f"run={run_dir}", f"demonstrations={tmp_path}/unfit.npz", "compilation_cache="]
    assert "', got those of 'panda'; env.expert=ARM sets the expert" in reason("evaluate", *arguments)


def test_a_checkpoint_of_another_environment(reason, run_dir, tmp_path):
    other = untrained_run(tmp_path / "other", learner=[0.4, 0.3, 0.3])
    shutil.rmtree(other / "checkpoints")
    shutil.copytree(run_dir / "checkpoints", other / "checkpoints")
    error = reason("evaluate", f"run={other}", "compilation_cache=")
    # The other learner has a link more, of 12 numbers, and a joint more, of 3.
    assert "does not fit the config of its run" in error and "expected shape (135,), got shape (120,)" in error


def test_a_run_does_not_start_from_networks_of_other_settings(reason, run_dir, tmp_path):
    fixed = f"init={run_dir}", "env=planar4dof", "env.horizon=20", "trainer.hidden_layers=[8]", "compilation_cache="
    changes = "env.preview=0", "env.expert.link_lengths=[0.5,0.4]", "env.learner.link_lengths=[0.5,0.5]"
    demonstrations = "env.demonstrations.count=4", "env.demonstrations.held_out=2"
    line = reason("train", *fixed, *changes, *demonstrations)
    expected, got = line.removeprefix("init: expected a run of ").split(", got one of ")
    assert "env.preview=0" in expected and "env.preview=1" in got
    assert "env.expert.link_lengths=[0.5,0.4]" in expected and "learner" not in line and "hidden" not in line


def test_a_run_is_not_resumed_with_other_layers(reason, run_dir):
    line = reason("train", f"resume={run_dir}", "trainer.hidden_layers=[7]", "compilation_cache=")
    assert line == "resume: expected a run of trainer.hidden_layers=[7], got one of trainer.hidden_layers=[8]"


@pytest.mark.parametrize("key", ["init", "resume"])
def test_a_training_names_the_key_of_what_is_no_run(reason, key):
    few = "env.demonstrations.count=1", "env.demonstrations.held_out=1"
    line = reason("train", "env=planar4dof", f"{key}=absent", *few)
    assert line == f"{key}: expected a run directory, which has a config.yaml, got 'absent'"


def test_a_run_of_braxs_loop_is_not_resumed(reason, tmp_path):
    trainer = {"loop": "brax", "final_learning_rate": 1.0, "final_entropy_cost": 1.0, "privileged_critic": False}
    run_dir = write_run(tmp_path / "run", [0.1], **trainer)
    assert "saves no training state" in reason("train", f"resume={run_dir}", "compilation_cache=")


def test_a_mapper_has_no_controllers(reason, tmp_path):
    run_dir = write_run(tmp_path / "run", [0.1], trainer="pose_mapper")
    save_checkpoint(run_dir, 0, {"weight": np.zeros(1, np.float32)})
    error = reason("evaluate", f"run={run_dir}", "controller=pd", "compilation_cache=")
    assert "expected a run of trainer=ppo, got one of pose_mapper" in error
