"""Training of one policy for many arms: what the trainer says, a run, and its resumption."""

import dataclasses
import json

import pytest

import mimic
from mimic.commands.fit import Run
from mimic.trainers.config import PPOConfig, TrainConfig
from mimic.trainers.make import make_ppo_trainer
from mimic.trainers.ppo.trainer import EVALUATED_DEMONSTRATIONS
from tests.helpers.commands import command
from tests.helpers.untrained_run import ARMS, family

COUNT, HELD_OUT = 3, 2
TINY = [
    "env=panda_family",
    "env.horizon=5",
    f"env.arms.most_locked={ARMS['most_locked']}",
    f"env.arms.unseen={ARMS['unseen']}".replace(" ", ""),
    f"env.demonstrations.count={COUNT}",
    f"env.demonstrations.held_out={HELD_OUT}",
    "trainer.num_envs=8",
    "trainer.unroll_length=5",
    "trainer.batch_size=4",
    "trainer.num_minibatches=2",
    "trainer.num_updates_per_batch=1",
    "trainer.hidden_layers=[8]",
    "trainer.num_timesteps=80",
    "trainer.evaluations=2",
]
METRICS = {
    "optimality_gap", "median_gap", "largest_gap", "controller_gap", "mean_distance", "lower_bound", "hold_distance",
    "speed_violations",
}  # fmt: skip
ROW = {"seen", "joints", "gap", "controller_gap", "mean_distance", "lower_bound", "hold_distance", "span"}


@pytest.fixture(scope="module")
def config():
    env = family()
    env = dataclasses.replace(env, demonstrations=dataclasses.replace(env.demonstrations, held_out=12))
    return TrainConfig(env, PPOConfig(hidden_layers=[8], preset="cpu", crossovers=4)).resolve()


@pytest.fixture(scope="module")
def trainer(config):
    return make_ppo_trainer(config, None)


def test_it_evaluates_the_arms_of_the_report(trainer):
    assert trainer.headline == f"panda_family: {COUNT} demonstrations, 512 arms in parallel"
    assert "report: 3 arms seen in training and 5 others, on 8 held-out demonstrations" in trainer.simulation
    assert trainer.env_config.physics == "fused" and trainer.columns == ("seen arms", "unseen arms")
    assert trainer._env.demonstrations.count == COUNT + 4 and trainer._demonstrations.count == COUNT + 12
    assert trainer.evaluator.env.demonstrations.count == EVALUATED_DEMONSTRATIONS


@pytest.mark.slow
def test_other_demonstrations_keep_their_length(config, trainer):
    longer = make_ppo_trainer(config, None, trainer._demonstrations.of_length(7)).evaluator.env
    assert longer.config.horizon == 7 and longer.demonstrations.count == EVALUATED_DEMONSTRATIONS


def metrics_of(gap):
    metrics = {key: {"train": gap, "held_out": 2 * gap} for key in METRICS}
    arm = {"joints": 7, "gap": gap, "seen": True}
    return {**metrics, "arms": {"whole": arm, "locked 2": {**arm, "seen": False, "gap": float("nan")}}}


def test_status_and_rows(trainer):
    assert trainer.status(metrics_of(0.1)) == "gap 10.00%, unseen arms 20.00%  without learning 10.00%/20.00%"
    rows = trainer.rows(metrics_of(0.1))
    assert rows[0] == ("optimality gap, mean over arms", "10.00%", "20.00%")
    assert ("    which is", "whole", "none") in rows and ("arms", "1", "1") in rows
    assert rows[-1] == ("  without gap (span below 25%)", "0", "1")
    assert "none" in trainer.status(metrics_of(float("nan")))


def test_fit_takes_no_environment_of_many_arms(trainer):
    with pytest.raises(ValueError, match="env: expected the name or the config of an environment of many arms"):
        mimic.fit(trainer._env)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("runs") / "family"
    result = command("train", *TINY, f"run_dir={run_dir}")
    assert result.returncode == 0, result.stderr[-2000:]
    return run_dir, result.stdout


@pytest.mark.slow
def test_a_run_directory_holds_everything(finished):
    run_dir, printed = finished
    names = {path.name for path in run_dir.iterdir()}
    assert {"config.yaml", "report.json", "metrics.csv", "demonstrations.npz", "checkpoints", "arms.csv"} <= names
    assert "training.png" in names
    report = json.loads((run_dir / "report.json").read_text())
    assert all(report[key].keys() == {"train", "held_out"} for key in METRICS)
    assert report["physics"] == "fused" and "mjx" not in report
    assert list(report["arms"])[:4] == ["whole", "locked 1", "locked 7", "locked 2"]
    assert all(row.keys() >= ROW for row in report["arms"].values())
    assert list(report["similarity"]) == ["policy", "controller", "nearest_poses", "hold_home"]
    assert "seen arms" in printed and "unseen arms" in printed and "without learning" in printed


@pytest.mark.slow
def test_it_can_be_resumed_evaluated_and_collected(finished, tmp_path):
    run_dir, _ = finished
    more = command("train", f"resume={run_dir}", "trainer.num_timesteps=160")
    assert more.returncode == 0, more.stderr[-2000:]
    report = json.loads((run_dir / "report.json").read_text())
    assert report["env_steps"] == 160
    again = Run(run_dir).evaluate(quiet=True)
    # 1e-5: the same function of the same parameters, in another process
    assert again["optimality_gap"] == pytest.approx(report["optimality_gap"], rel=1e-5)
    alone = Run(run_dir).evaluate(quiet=True, controller="nearest_pose")
    assert alone["optimality_gap"] == alone["controller_gap"] and alone["trainer"] == "nearest_pose"
    collected = command("collect", str(run_dir.parent), f"out={tmp_path}")
    assert collected.returncode == 0 and "panda_family" not in collected.stderr
