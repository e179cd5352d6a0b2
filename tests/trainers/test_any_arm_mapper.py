"""The pose mapper of any arm: training, resuming, its report, loading, and bad input."""

import csv
import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.arms.arrays import MAX_JOINTS, lock_joints, stack_arms
from mimic.commands import retarget
from mimic.commands.config import EvaluateConfig, RetargetConfig
from mimic.commands.evaluate import prepare_evaluation
from mimic.envs import env_config
from mimic.envs.family import arm_sampler
from mimic.metric.similarity import MEASURES
from mimic.runs.checkpoints import checkpoint_steps
from mimic.trainers import run_training as session
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper.any_arm_evaluation import METHODS, Mapped, Reference, best_poses, table_of_pairs
from mimic.trainers.pose_mapper.any_arm_mapper import AnyArmMapper, load_mapper
from mimic.trainers.pose_mapper.any_arm_model import expert_pose, make_any_arm_model
from mimic.trainers.pose_mapper.any_arm_trainer import AnyArmMapperTrainer
from mimic.trainers.pose_mapper.any_arm_training import any_arm_objective, random_pose

TINY: dict[str, Any] = {
    "width": 16, "layers": 1, "heads": 2, "guesses": 1, "refinements": 1, "samples": 64, "batch_size": 32, "epochs": 2,
    "evaluations": 2, "validation_poses": 8, "held_out_poses": 2,
}  # fmt: skip
FEW_ARMS = {"locked_fraction": 1.0, "most_locked": 1, "unseen": ["2", "5", "1+4"]}


def run_config(run_dir, *, arms: Any = None, seed=0, **settings):
    env = env_config("panda_family", arms=arms or FEW_ARMS)
    trainer = PoseMapperConfig(**{**TINY, **settings})
    return TrainConfig(env, trainer, seed=seed, run_dir=str(run_dir), compilation_cache="")


def train(run_dir, **settings):
    assert session.prepare_training(run_config(run_dir, **settings), 0.0)() == 0
    return json.loads((run_dir / "report.json").read_text())


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("any_arm") / "run"
    return run_dir, train(run_dir)


@pytest.fixture(scope="module")
def mapper(trained):
    return AnyArmMapper.load(trained[0])


def poses(count, seed=0):
    return np.random.default_rng(seed).uniform(-3, 3, (count, 7)).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("guesses", [0, 5])
def test_guesses_are_constant_poses_beside_the_proposals(mapper, guesses):
    model = dataclasses.replace(mapper.model, guesses=guesses)
    learner = jax.tree.map(jnp.asarray, lock_joints(mapper.arrays("panda"), np.arange(MAX_JOINTS) == 2))
    experts = [expert_pose(model.expert, jnp.full(MAX_JOINTS, angle)) for angle in (0.1, 0.5)]
    initial = [np.asarray(model.initial_poses(mapper.params, expert, learner)) for expert in experts]
    lower, upper = np.asarray(learner.joint_range).T
    for expert, poses_of_expert in zip(experts, initial, strict=True):
        assert poses_of_expert.shape == (model.starts, MAX_JOINTS) == (2 + guesses, MAX_JOINTS)
        np.testing.assert_array_equal(poses_of_expert[:2], model.candidates(mapper.params, expert, learner))
        assert np.all((poses_of_expert[2:] >= lower) & (poses_of_expert[2:] <= upper))
        np.testing.assert_array_equal(poses_of_expert[:, 2], learner.home[2])
    np.testing.assert_array_equal(initial[0][2:], initial[1][2:])
    assert len(np.unique(initial[0][2:], axis=0)) == guesses


@pytest.mark.slow
def test_a_run_reports_each_arm(trained):
    run_dir, report = trained
    assert report["training_poses"] == TINY["samples"] * TINY["epochs"]
    for key in (*METHODS, "quality_largest", "mean_distance", "optimal_distance", "random_distance"):
        assert set(report[key]) == {"train", "held_out"}
    assert {name for name, arm in report["arms"].items() if not arm["seen"]} == {"locked 2", "locked 5", "locked 1+4"}
    assert len(report["arms"]) == 6 + 3 and report["arms"]["locked 1+4"]["joints"] == 5
    seen = [arm["quality"] for arm in report["arms"].values() if arm["seen"]]
    assert report["quality"]["train"] == pytest.approx(np.mean(seen))
    assert report["quality_largest"]["train"] == max(seen)
    for method in ("mapper", "nearest_poses", "random_guesses"):
        assert set(report["similarity"][method]) == set(MEASURES)
    with (run_dir / "arms.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["arm"] for row in rows] == list(report["arms"]) and rows[0]["arms"] == "seen"
    assert {"arms.png", "training.png", "metrics.csv"} <= {path.name for path in run_dir.iterdir()}


@pytest.mark.slow
def test_evaluate_repeats_the_report(trained, tmp_path):
    run_dir, report = trained
    out = tmp_path / "again"
    prepare_evaluation(EvaluateConfig(str(run_dir), out=str(out), compilation_cache=""), 0.0)()
    again = json.loads((out / "report.json").read_text())
    for key in ("quality", "optimal_distance", "similarity", "arms"):
        assert again[key] == report[key]
    assert (out / "arms.csv").read_text() == (run_dir / "arms.csv").read_text()


@pytest.mark.slow
def test_splits_without_arms_are_left_out(tmp_path):
    """All arms are seen in training; and if the config names none that are, the report draws some."""
    config = run_config(tmp_path, arms={"locked_fraction": 1.0, "most_locked": 1, "unseen": []})
    trainer = AnyArmMapperTrainer(config.resolve())
    distances = np.linspace(0.1, 0.2, 16).reshape(8, 2)
    mapped = Mapped(distances, np.zeros((8, 2, MAX_JOINTS)), distances)
    reference = Reference(distances / 2, mapped.qpos, distances, mapped.qpos, distances, distances + 1)
    vars(trainer)["_reference"] = {"arms": reference}
    metrics = trainer.metrics({"arms": mapped})
    assert set(metrics["quality"]) == {"train"} and "unseen" not in trainer.status(metrics)
    assert trainer.rows(metrics)[0] == ("number of arms", "8", "0") and trainer.rows(metrics)[1][2] == ""
    config = run_config(tmp_path, arms={"locked_fraction": 0.0, "unseen": [], "random_fraction": 1.0})
    drawn = AnyArmMapperTrainer(config.resolve())
    assert len(drawn._arms["train"]) == 16 and len(drawn._arms["held_out"]) == 16


@pytest.mark.slow
def test_a_resumed_run_is_that_of_one_without_an_interruption(trained, tmp_path):
    run_dir = tmp_path / "run"
    constant = {"final_learning_rate": 1.0}  # a decay depends on the number of epochs
    train(run_dir, **constant, epochs=1)
    config = TrainConfig(resume=str(run_dir), compilation_cache="")
    # The second makes the command line accept the third.
    overrides = [f"resume={run_dir}", "trainer=pose_mapper", "trainer.epochs=2"]
    assert session.prepare_training(config, 0.0, overrides)() == 0
    train(tmp_path / "whole", **constant)
    resumed, whole = (AnyArmMapper.load(path) for path in (run_dir, tmp_path / "whole"))
    jax.tree.map(np.testing.assert_array_equal, resumed.params, whole.params)
    assert checkpoint_steps(run_dir) == [0, 64, 128]
    assert not np.array_equal(*(jax.tree.leaves(x.params)[0] for x in (whole, AnyArmMapper.load(trained[0]))))


@pytest.mark.slow
def test_poses_of_a_learner_have_its_joints(mapper):
    qpos = poses(6)
    locked = mimic.ArmConfig(locked=["joint2"])
    for learner, joints in (("panda", 7), ("panda4dof", 4), (mimic.build_arm(locked), 6)):
        learner_poses = np.asarray(mapper(qpos, learner))
        assert learner_poses.shape == (6, joints) and np.all(np.isfinite(learner_poses))
        np.testing.assert_allclose(mapper(qpos[2], learner), learner_poses[2], atol=1e-4)
        np.testing.assert_allclose(mapper(qpos.reshape(2, 3, 7), learner), learner_poses.reshape(2, 3, -1), atol=1e-4)
        one = mapper.to(learner)
        # A Newton step magnifies rounding errors.
        np.testing.assert_allclose(one(qpos), learner_poses, atol=1e-3)
        assert one.learner.num_joints == joints


@pytest.mark.slow
def test_joints_that_a_config_locks_are_locked_by_the_mask(mapper):
    """As in training; the pose and its distance are those of the arm whose locked joints are no joints."""
    config = mimic.ArmConfig(locked={"joint2": 0.4, "joint5": -0.3})
    described = mapper.describe(config)
    assert described.slots == mimic.panda().joint_names and list(described.joints) == [0, 2, 3, 5, 6]
    np.testing.assert_allclose(described.arrays.home[[1, 4]], [0.4, -0.3], rtol=1e-6)
    np.testing.assert_array_equal(described.arrays.is_free, [1, 0, 1, 1, 0, 1, 1, 0])
    one, (qpos,) = mapper.to(config), poses(1)
    metric = mapper.env.metric.build(one.expert, one.learner)
    learner_qpos = one(qpos)
    expected = metric(mimic.link_states(one.expert, qpos), mimic.link_states(one.learner, learner_qpos))
    np.testing.assert_allclose(one.model.distance(jnp.asarray(qpos), learner_qpos), expected, rtol=1e-4)


@pytest.mark.slow
def test_the_nearest_pose_is_taken_and_locked_joints_stay(mapper):
    arm = lock_joints(mapper.arrays("panda"), np.eye(MAX_JOINTS)[3])
    (qpos,) = poses(1)
    expert = expert_pose(mapper.model.expert, jnp.append(qpos, 0.0))
    refined, distances = mapper.model.refined(mapper.params, expert, arm)
    result = np.asarray(mapper(qpos, arm))
    np.testing.assert_allclose(result, refined[int(np.argmin(distances))], atol=1e-4)
    assert result.shape == (MAX_JOINTS,) and result[3] == arm.home[3] and result[7] == 0


@pytest.mark.slow
def test_a_batch_of_arms_is_mapped_by_vmap(mapper):
    arms = [lock_joints(mapper.arrays("panda"), row) for row in np.eye(MAX_JOINTS)[:3]]
    qpos = poses(2)
    batch = jax.vmap(mapper, (None, 0))(qpos, stack_arms(arms))
    for row, arm in zip(batch, arms, strict=True):
        np.testing.assert_allclose(row, mapper(qpos, arm), atol=1e-3)


@pytest.mark.slow
def test_motions_are_retargeted_to_any_learner(trained, tmp_path):
    env = mimic.make("panda4dof", demonstrations={"count": 2, "held_out": 1})
    env.demonstrations.save(tmp_path / "expert.npz")
    for learner, joints in (("panda4dof", 4), ("panda3dof", 3)):
        out = tmp_path / f"{learner}.npz"
        config = RetargetConfig(str(tmp_path / "expert.npz"), env_config(learner), str(trained[0]), out=str(out))
        retarget.prepare_retargeting(config)()
        assert mimic.load_demonstrations(out).qpos.shape == (2, 51, joints)


@pytest.mark.slow
def test_training_reduces_the_loss():
    """Two hundred updates of the smallest network lower the distance of its proposals by a third."""
    from mimic.trainers.pose_mapper import training

    config = run_config("", samples=6400, epochs=1, learning_rate=1e-2).trainer
    assert isinstance(config, PoseMapperConfig)
    env = env_config("panda_family", arms=FEW_ARMS)
    settings = config.resolve(env=env)
    model = make_any_arm_model(env, settings)
    objective = any_arm_objective(model, arm_sampler(env))
    optimiser = training._optimiser(settings)
    run = jax.jit(training._training_epoch(objective, settings, optimiser, 1))
    params, keys = objective.init(jax.random.key(0)), objective.draw(jax.random.key(1), 256)
    (trained, _), _ = run((params, optimiser.init(params)), 0, 0, objective.draw(jax.random.key(2), 6400))
    before, after = (float(jax.jit(objective.distances)(x, keys).min(axis=1).mean()) for x in (params, trained))
    assert after < 2 / 3 * before


def test_the_optimum_is_the_nearest_pose_that_is_known():
    """One arm, two poses: the mapper is nearer in the first, the reference in the second."""
    reference = Reference(
        optimal_distance=np.array([[0.2, 0.1]]),
        optimal_qpos=np.zeros((1, 2, MAX_JOINTS)),
        guessed_distance=np.array([[0.4, 0.3]]),
        guessed_qpos=np.zeros((1, 2, MAX_JOINTS)),
        home_distance=np.array([[0.5, 0.5]]),
        random_distance=np.array([[1.1, 1.1]]),
    )
    mapped = Mapped(np.array([[0.1, 0.3]]), np.ones((1, 2, MAX_JOINTS)), np.array([[0.6, 0.6]]))
    table = table_of_pairs(reference, mapped)
    expected = {"optimal_distance": 0.1, "mean_distance": 0.2, "quality": 0.1, "quality_random_guesses": 0.25,
                "quality_from_home": 0.4, "quality_proposed": 0.5}  # fmt: skip
    for key, value in expected.items():
        np.testing.assert_allclose(table[key], [value], rtol=1e-6)
    np.testing.assert_array_equal(best_poses(reference, mapped)[0, :, 0], [1.0, 0.0])


@pytest.mark.slow
def test_random_poses_leave_locked_joints_at_home(mapper):
    arm = dataclasses.replace(lock_joints(mapper.model.expert, np.eye(MAX_JOINTS)[0]), home=np.full(MAX_JOINTS, 0.5))
    drawn = jax.vmap(lambda key: random_pose(arm, key))(jax.random.split(jax.random.key(0), 200))
    assert np.all(drawn[:, 0] == 0.5) and np.all(drawn[:, 7] == 0.5)
    lower, upper = arm.joint_range[1:7].T
    assert np.all((drawn[:, 1:7] >= lower) & (drawn[:, 1:7] <= upper)) and np.ptp(drawn[:, 1]) > 5


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"preset": "large"}, "trainer.preset: expected any_arm or any_arm_cpu for a mapper to any arm"),
        ({"hidden_layers": [16]}, "trainer.hidden_layers: expected none for a mapper to any arm"),
        ({"activation": "gelu"}, "trainer.activation: expected none for a mapper to any arm"),
        ({"width": 18}, "trainer.width: expected a multiple of 4, got 18"),
        ({"batch_size": 48}, "trainer.batch_size: expected a divisor of samples = 64, got 48"),
    ],
)
def test_settings_that_do_not_apply_are_rejected(settings, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        session.prepare_training(run_config(tmp_path / "run", **settings), 0.0)


def test_settings_of_any_arm_are_rejected_for_one_learner():
    with pytest.raises(ValueError, match="trainer.width: expected none for a mapper to one learner, got 16"):
        PoseMapperConfig(width=16).resolve()
    with pytest.raises(ValueError, match="trainer.guesses: expected none for a mapper to one learner, got 0"):
        PoseMapperConfig(guesses=0).resolve()
    with pytest.raises(ValueError, match="trainer.preset: expected paper or large for a mapper to one learner"):
        PoseMapperConfig(preset="any_arm").resolve(env=env_config("panda4dof"))


def test_the_backend_chooses_the_preset():
    for backend, preset in (("cpu", "any_arm_cpu"), ("gpu", "any_arm")):
        settings = PoseMapperConfig().resolve(backend, env=env_config("panda_family"))
        assert settings.preset == preset
        unset = [field.name for field in dataclasses.fields(PoseMapperConfig) if getattr(settings, field.name) is None]
        assert set(unset) == {"inputs", "outputs", "hidden_layers", "activation"}
    assert PoseMapperConfig().resolve().preset == "large"


def test_a_metric_that_arrays_do_not_have_is_rejected(tmp_path):
    config = run_config(tmp_path / "run")
    config = dataclasses.replace(config, env=env_config("panda_family", metric="paper"))
    with pytest.raises(ValueError, match="metric: expected the default one"):
        session.prepare_training(config, 0.0)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_bad_learners_and_poses_are_rejected(mapper):
    arms = stack_arms([mapper.arrays("panda")] * 2)
    cases = [
        ((np.zeros(6), "panda"), r"expected shape \[\.\.\., 7\]"),
        ((np.full(7, np.nan), "panda"), "expected finite angles"),
        ((np.zeros(7), "bimanual"), "expected a serial arm, got a tree of 2 chains"),
        ((np.zeros(7), "missing.xml"), "no MJCF or URDF file"),
        ((np.zeros(7), arms), "use jax.vmap for many arms"),
    ]
    for arguments, message in cases:
        with pytest.raises(ValueError, match=message):
            mapper(*arguments)


@pytest.mark.slow
def test_runs_of_the_other_kind_are_rejected(trained, tmp_path):
    with pytest.raises(ValueError, match="expected a run with one learner, got env=panda_family"):
        mimic.PoseMapper.load(trained[0])
    assert load_mapper(trained[0]).learner.num_joints == 7
    (tmp_path / "config.yaml").write_text("trainer: {name: pose_mapper}\nenv: {name: panda4dof}\n")
    with pytest.raises(ValueError, match="got one of trainer=pose_mapper env=panda4dof"):
        AnyArmMapper.load(tmp_path)
