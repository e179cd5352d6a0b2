"""The pose mapper: training, resuming, loading, and bad input."""

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.commands.config import EvaluateConfig
from mimic.commands.evaluate import prepare_evaluation
from mimic.envs import env_config
from mimic.runs.checkpoints import checkpoint_steps
from mimic.trainers import run_training as session
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper.model import make_model
from mimic.trainers.pose_mapper.trainer import PoseMapperTrainer
from tests.helpers.metric_cases import random_poses
from tests.helpers.tiny import SHORT_ARMS

SMALL = {"samples": 8192, "batch_size": 256, "epochs": 40, "evaluations": 2, "hidden_layers": [64, 64]}
SHORT: dict[str, Any] = {"samples": 256, "batch_size": 64, "epochs": 4, "evaluations": 1}
FEW = {"validation_poses": 64, "held_out_poses": 256}
REPORT_KEYS = {
    "env", "trainer", "seed", "quality", "mean_distance", "optimal_distance", "random_distance",
    "link_angle_error_deg", "link_angle_to_optimum_deg_by_link", "wall_time_s", "training_poses", "steps_per_second",
    "hardware", "versions",
}  # fmt: skip


def run_config(run_dir, *, env="planar4dof", arms=None, seed=0, limits="none", **settings):
    trainer = PoseMapperConfig(**{**SMALL, **FEW, **settings})
    environment = env_config(env, limits=limits, **(arms or {}))
    return TrainConfig(environment, trainer, seed=seed, run_dir=str(run_dir), compilation_cache="")


def train(run_dir, **settings):
    assert session.prepare_training(run_config(run_dir, **settings), 0.0)() == 0
    return json.loads((run_dir / "report.json").read_text())


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of one second, of short arms."""
    run_dir = tmp_path_factory.mktemp("mapper") / "run"
    return run_dir, train(run_dir, arms=SHORT_ARMS, **SHORT)


@pytest.mark.slow
def test_it_learns(tmp_path):
    """A small network and a third of a million poses; the preset gets below 0.1 %."""
    report = train(tmp_path / "run")
    assert report["quality"]["held_out"] < 0.05
    learned_by_heart = report["quality"]["held_out"] - report["quality"]["train"]
    assert abs(learned_by_heart) < 0.02  # fresh poses cannot be


def test_a_run_reports_what_it_trained_with(trained):
    run_dir, report = trained
    assert report.keys() >= REPORT_KEYS
    assert report["quality"]["held_out"] < 1  # better than random poses
    assert report["quality"].keys() == {"train", "validation", "held_out"}
    assert report["optimal_distance"]["held_out"] < report["mean_distance"]["held_out"]
    assert report["training_poses"] == SHORT["samples"] * SHORT["epochs"]
    assert {"config.yaml", "report.json", "metrics.csv", "training.png"} <= {path.name for path in run_dir.iterdir()}


@pytest.mark.slow
def test_evaluate_repeats_the_report(trained, tmp_path):
    run_dir, report = trained
    out = tmp_path / "again"
    prepare_evaluation(EvaluateConfig(str(run_dir), out=str(out), compilation_cache=""), 0.0)()
    again = json.loads((out / "report.json").read_text())
    for key in ("quality", "mean_distance", "optimal_distance"):
        assert again[key] == pytest.approx(report[key], rel=1e-5)


@pytest.mark.slow
def test_a_loaded_mapper_takes_one_pose_or_many(trained):
    run_dir, report = trained
    mapper = mimic.PoseMapper.load(run_dir)
    qpos = random_poses(mapper.expert, 12)
    batch = mapper(qpos)
    assert batch.shape == (12, mapper.learner.num_joints) and np.all(np.abs(batch) <= np.pi + 1e-6)
    np.testing.assert_allclose(batch[3], mapper(qpos[3]), atol=1e-5)
    np.testing.assert_allclose(batch, jax.jit(mapper)(qpos), atol=1e-5)
    np.testing.assert_allclose(batch, jax.vmap(mapper)(qpos), atol=1e-5)
    np.testing.assert_allclose(mapper(qpos.reshape(3, 4, -1)), batch.reshape(3, 4, -1), atol=1e-5)
    np.testing.assert_allclose(mapper(qpos + 2 * np.pi), batch, atol=1e-3)  # a full turn is the same pose
    distance = jax.vmap(mapper.distance)(jnp.asarray(qpos), batch)
    assert np.mean(distance) < report["random_distance"]["held_out"]


def test_the_nearest_head_is_taken(trained):
    mapper = mimic.PoseMapper.load(trained[0])
    qpos = jnp.asarray(random_poses(mapper.expert, 5)[2])
    candidates = jax.jit(mapper.candidates)(qpos)
    distances = jax.jit(jax.vmap(mapper.distance, (None, 0)))(qpos, candidates)
    np.testing.assert_allclose(jax.jit(mapper)(qpos), candidates[int(np.argmin(distances))], atol=1e-6)


@pytest.mark.slow
def test_resume_continues(tmp_path):
    run_dir = tmp_path / "run"
    short = train(run_dir, epochs=4)
    config = TrainConfig(resume=str(run_dir), compilation_cache="")
    with pytest.raises(ValueError, match="increase trainer.epochs"):
        session.prepare_training(config, 0.0)
    assert session.prepare_training(config, 0.0, [f"resume={run_dir}", "trainer.epochs=8"])() == 0
    report = json.loads((run_dir / "report.json").read_text())
    assert report["training_poses"] == 2 * short["training_poses"]
    assert report["quality"]["held_out"] < short["quality"]["held_out"]


@pytest.mark.slow
def test_the_paper_overfits_and_early_stopping_goes_back_to_the_best(tmp_path):
    run_dir = tmp_path / "run"
    settings = {"samples": 64, "batch_size": 32, "epochs": 400, "evaluations": 40, "patience": 3}
    report = train(run_dir, env="planar4dof", preset="paper", hidden_layers=[32, 32, 32], **settings)
    assert report["quality"]["train"] < report["quality"]["held_out"] - 0.05
    lines = (run_dir / "metrics.csv").read_text().splitlines()
    column = lines[0].split(",").index("training/validation_distance")
    rows = [line.split(",") for line in lines[1:]]
    best = min(rows, key=lambda row: float(row[column]))
    assert len(rows) < 40 and rows.index(best) == len(rows) - 4  # stopped by patience
    steps = checkpoint_steps(run_dir)
    assert max(steps) == int(best[0]) == report["training_poses"]


def test_evaluation_poses_are_not_training_poses(tmp_path):
    jobs = [PoseMapperTrainer(run_config(tmp_path, seed=seed).resolve()) for seed in (0, 1)]
    for job in jobs:
        training_poses = np.asarray(job.samples["train"])
        of_report = job.poses[-FEW["held_out_poses"] :]
        for unseen in (np.asarray(job.samples["validation"]), of_report):
            assert not (unseen[:, None] == training_poses[None, :512]).all(axis=-1).any()
    few = FEW["validation_poses"]
    np.testing.assert_array_equal(*(job.poses[few:] for job in jobs))
    assert not np.array_equal(*(job.poses[:few] for job in jobs))


@pytest.mark.slow
def test_limited_joints_stay_within_their_limits():
    model = make_model(env_config("panda4dof", limits="hardware"), PoseMapperConfig(**SMALL).resolve())
    large = jax.tree.map(lambda x: 10 * x, model.init(jax.random.key(0)))  # most outputs near their ends
    mapper = mimic.PoseMapper(model, large)
    lower, upper = mapper.learner.joint_range.T
    learner_poses = mapper(random_poses(mapper.expert, 64))
    assert np.any(learner_poses < lower + 1e-3) and np.any(learner_poses > upper - 1e-3)
    assert np.all((learner_poses >= lower - 1e-5) & (learner_poses <= upper + 1e-5))
    with pytest.raises(ValueError, match="joint1 at 3.0000 rad is outside of its range"):
        mapper(np.array([3.0, 0, 0, -1, 0, 1, 0]))


def test_an_environment_that_draws_its_learner_is_rejected(reason):
    assert reason("train", "trainer=pose_mapper", "env=any_arm") == (
        "trainer: expected ppo where the learner is drawn for each episode, env=any_arm, got pose_mapper, which has "
        "one learner; imitate_pose takes any arm as data, without a training"
    )


@pytest.mark.parametrize(
    ("qpos", "message"),
    [
        (np.zeros(6), r"expected shape \[\.\.\., 3\] for planar3, got \(6,\)"),
        (np.full(3, np.nan), "expected finite angles"),
        (np.zeros(()), "expected shape"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_poses_are_rejected(trained, qpos, message):
    with pytest.raises(ValueError, match=message):
        mimic.PoseMapper.load(trained[0])(qpos)


def test_a_mapper_of_other_arms_or_of_no_run_is_rejected(trained, tmp_path):
    mapper = mimic.PoseMapper.load(trained[0])
    mapper.check_fits(mapper.expert, mapper.learner)
    with pytest.raises(ValueError, match="its learner is planar2"):
        mapper.check_fits(mapper.expert, mimic.panda())
    with pytest.raises(ValueError, match="run_dir: expected a run directory"):
        mimic.PoseMapper.load(tmp_path)
    (tmp_path / "config.yaml").write_text("trainer: {name: ppo}\n")
    with pytest.raises(ValueError, match="expected a run of trainer=pose_mapper, got one of ppo"):
        mimic.PoseMapper.load(tmp_path)


@pytest.mark.slow
def test_the_large_preset_is_within_2_percent_of_the_optimum(tmp_path):
    config = TrainConfig(
        env_config("panda4dof"), PoseMapperConfig(), run_dir=str(tmp_path / "run"), compilation_cache=""
    )
    assert session.prepare_training(config, 0.0)() == 0
    assert json.loads((tmp_path / "run" / "report.json").read_text())["quality"]["held_out"] <= 0.02
