"""The pose mapper of any arms: training, resuming, report, experts and learners that a caller names, and bad input."""

import csv
import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS, lock_joints, stack_arms
from mimic.commands import retarget
from mimic.commands.config import EvaluateConfig, RetargetConfig
from mimic.commands.evaluate import prepare_evaluation
from mimic.envs import env_config
from mimic.envs.family import arm_sampler
from mimic.metric.similarity import MEASURES
from mimic.runs.checkpoints import checkpoint_steps, save_checkpoint
from mimic.trainers import run_training as session
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper import training
from mimic.trainers.pose_mapper.evaluation import METHODS, Mapped, Reference, best_poses, table_of_pairs
from mimic.trainers.pose_mapper.mapper import load_mapper
from mimic.trainers.pose_mapper.mapper_arm import describe_arm
from mimic.trainers.pose_mapper.model import make_model
from mimic.trainers.pose_mapper.pair import random_poses
from mimic.trainers.pose_mapper.trainer import PoseMapperTrainer
from mimic.trainers.run_config import save_config

TINY: dict[str, Any] = {
    "width": 16, "layers": 1, "heads": 2, "guesses": 1, "refinements": 1, "samples": 64, "batch_size": 32, "epochs": 2,
    "evaluations": 2, "validation_poses": 8, "held_out_poses": 2,
}  # fmt: skip
FEW_ARMS = {"locked_fraction": 1.0, "most_locked": 1, "unseen": ["2", "5", "1+4"]}
DRAWN = {"expert": "drawn", **FEW_ARMS}
FOUR = mimic.ArmConfig(locked=[3, 6, 7])
ATOL = 1e-3  # rad: a Newton step magnifies rounding errors


def run_config(run_dir, *, arms: Any = None, **settings):
    trainer = PoseMapperConfig(**{**TINY, **settings})
    return TrainConfig(
        env_config("panda_family", arms=arms or FEW_ARMS), trainer, 0, str(run_dir), compilation_cache=""
    )


def train(run_dir, **settings):
    assert session.prepare_training(run_config(run_dir, **settings), 0.0)() == 0
    return json.loads((run_dir / "report.json").read_text())


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run whose experts are drawn too."""
    run_dir = tmp_path_factory.mktemp("any_arm") / "run"
    return run_dir, train(run_dir, arms=DRAWN)


def untrained_run(run_dir, arms):
    config = run_config(run_dir, arms=arms).resolve()
    run_dir.mkdir()
    save_config(run_dir, config)
    shapes, rng = (
        jax.eval_shape(make_model(config.env, config.trainer).init, jax.random.key(0)),
        np.random.default_rng(0),
    )
    save_checkpoint(run_dir, 1, jax.tree.map(lambda x: rng.normal(0, 0.2, x.shape).astype(x.dtype), shapes))
    return run_dir


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return {"fixed": untrained_run(folder / "fixed", FEW_ARMS), "drawn": untrained_run(folder / "drawn", DRAWN)}


@pytest.fixture(scope="module")
def mapper(runs):
    return mimic.PoseMapper.load(runs["drawn"])


def poses(count, joints=7, seed=0):
    return np.random.default_rng(seed).uniform(-2, 2, (count, joints)).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("guesses", [0, 5])
def test_guesses_are_constant_poses_beside_the_proposals(mapper, guesses):
    model = dataclasses.replace(mapper.model, config=dataclasses.replace(mapper.model.config, guesses=guesses))
    learner = jax.tree.map(jnp.asarray, lock_joints(mapper.arrays("panda"), np.arange(MAX_JOINTS) == 2))
    targets = [model.pair(learner).target(jnp.full(MAX_JOINTS, angle)) for angle in (0.1, 0.5)]
    initial = [np.asarray(model.initial_poses(mapper.params, target)) for target in targets]
    lower, upper = np.asarray(learner.joint_range).T
    for target, poses_of_target in zip(targets, initial, strict=True):
        assert poses_of_target.shape == (model.starts, MAX_JOINTS) == (2 + guesses, MAX_JOINTS)
        np.testing.assert_array_equal(poses_of_target[:2], model.candidates(mapper.params, target))
        assert np.all((poses_of_target[2:] >= lower) & (poses_of_target[2:] <= upper))
        np.testing.assert_array_equal(poses_of_target[:, 2], learner.home[2])
    np.testing.assert_array_equal(initial[0][2:], initial[1][2:])
    assert len(np.unique(initial[0][2:], axis=0)) == guesses


@pytest.mark.slow
def test_a_run_reports_each_arm_and_each_pair(trained):
    run_dir, report = trained
    assert report["training_poses"] in checkpoint_steps(run_dir)  # of the best checkpoint
    names, pairs = list(report["arms"]), list(report["pairs"])
    assert names == ["whole", *(f"locked {i}" for i in (1, 3, 4, 6, 7)), "locked 2", "locked 5", "locked 1+4"]
    assert pairs[:2] == ["locked 7 to whole", "whole to locked 1"] and pairs[6] == "locked 1+4 to locked 2"
    assert {name for name, arm in report["arms"].items() if not arm["seen"]} == {"locked 2", "locked 5", "locked 1+4"}
    assert report["arms"]["locked 1+4"]["joints"] == 5
    for metrics, table in ((report, "arms"), (report["other_experts"], "pairs")):
        for key in (*METHODS, "quality_largest", "mean_distance", "optimal_distance", "random_distance"):
            assert set(metrics[key]) == {"train", "held_out"}
        seen = [arm["quality"] for arm in report[table].values() if arm["seen"]]
        assert metrics["quality"]["train"] == pytest.approx(np.mean(seen)) and len(seen) == 6
        assert metrics["quality_largest"]["train"] == max(seen)
        with (run_dir / f"{table}.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert [row["arm"] for row in rows] == list(report[table]) and rows[0]["arms"] == "seen"
    for method in ("mapper", "nearest_poses", "random_guesses"):
        assert set(report["similarity"][method]) == set(MEASURES)
    assert {"arms.png", "training.png", "metrics.csv"} <= {path.name for path in run_dir.iterdir()}


@pytest.mark.slow
def test_evaluate_repeats_the_report(trained, tmp_path):
    run_dir, report = trained
    out = tmp_path / "again"
    prepare_evaluation(EvaluateConfig(str(run_dir), out=str(out), compilation_cache=""), 0.0)()
    again = json.loads((out / "report.json").read_text())
    for key in ("quality", "optimal_distance", "similarity", "arms", "pairs"):
        assert again[key] == report[key]
    assert (out / "arms.csv").read_text() == (run_dir / "arms.csv").read_text()


@pytest.mark.slow
def test_splits_without_arms_are_left_out(tmp_path):
    """All arms are seen in training; and if the config names none that are, the report draws some."""
    config = run_config(tmp_path, arms={"locked_fraction": 1.0, "most_locked": 1, "unseen": []})
    trainer = PoseMapperTrainer(config.resolve())
    distances = np.linspace(0.1, 0.2, 16).reshape(8, 2)
    mapped = Mapped(distances, np.zeros((8, 2, MAX_JOINTS)), distances)
    reference = Reference(distances / 2, mapped.qpos, distances + 1, distances, mapped.qpos, distances)
    vars(trainer)["_reference"] = {"arms": reference}
    metrics = trainer.metrics({"arms": mapped})
    assert set(metrics["quality"]) == {"train"} and "unseen" not in trainer.status(metrics)
    assert trainer.rows(metrics)[0] == ("number of arms", "8", "0") and trainer.rows(metrics)[1][2] == ""
    config = run_config(tmp_path, arms={"locked_fraction": 0.0, "unseen": [], "random_fraction": 1.0})
    rows = PoseMapperTrainer(config.resolve())._arms.rows["arms"]
    assert sum(row.seen for row in rows) == 16 and len(rows) == 32


@pytest.mark.slow
def test_a_resumed_run_is_that_of_one_without_an_interruption(tmp_path):
    run_dir = tmp_path / "run"
    constant = {"final_learning_rate": 1.0}  # a decay depends on the number of epochs
    train(run_dir, **constant, epochs=1)
    config = TrainConfig(resume=str(run_dir), compilation_cache="")
    # The second makes the command line accept the third.
    overrides = [f"resume={run_dir}", "trainer=pose_mapper", "trainer.epochs=2"]
    assert session.prepare_training(config, 0.0, overrides)() == 0
    train(tmp_path / "whole", **constant)
    resumed, whole = (mimic.PoseMapper.load(path) for path in (run_dir, tmp_path / "whole"))
    jax.tree.map(np.testing.assert_array_equal, resumed.params, whole.params)
    assert checkpoint_steps(run_dir) == [0, 64, 128]


@pytest.mark.slow
def test_poses_of_a_learner_have_its_joints(mapper):
    qpos = poses(6)
    locked = mimic.ArmConfig(locked=["joint2"])
    for learner, joints in (("panda", 7), ("panda4dof", 4), (mimic.build_arm(locked), 6)):
        learner_poses = np.asarray(mapper(qpos, learner))
        assert learner_poses.shape == (6, joints) and np.all(np.isfinite(learner_poses))
        np.testing.assert_allclose(mapper(qpos[2], learner), learner_poses[2], atol=ATOL)
        np.testing.assert_allclose(mapper(qpos.reshape(2, 3, 7), learner), learner_poses.reshape(2, 3, -1), atol=ATOL)
        one = mapper.to(learner)
        np.testing.assert_allclose(one(qpos), learner_poses, atol=ATOL)
        assert one.learner.num_joints == joints


@pytest.mark.slow
def test_an_expert_is_the_same_in_all_its_forms(mapper):
    """A config, the arm that it builds, and arrays with angles in all slots, those of locked joints ignored."""
    qpos = poses(5, 4)
    learner_qpos = np.asarray(mapper(qpos, "panda", FOUR))
    assert learner_qpos.shape == (5, 7)
    slots = np.full((5, MAX_JOINTS), 9.0)
    slots[:, [0, 1, 3, 4]] = qpos
    forms = [("panda4dof", qpos), (mimic.build_arm(FOUR), qpos), (mapper.arrays(FOUR), slots)]
    for expert, expert_qpos in forms:
        np.testing.assert_allclose(mapper(expert_qpos, "panda", expert), learner_qpos, atol=ATOL)
    np.testing.assert_allclose(mapper.to("panda", FOUR)(qpos), learner_qpos, atol=ATOL)
    batch = jax.vmap(mapper, (0, None, 0))(slots[:, None], "panda", stack_arms([mapper.arrays(FOUR)] * 5))
    np.testing.assert_allclose(batch[:, 0], learner_qpos, atol=ATOL)
    of_whole = poses(3)  # the expert of the environment is the default
    np.testing.assert_allclose(mapper(of_whole, FOUR), mapper(of_whole, FOUR, "panda"), atol=ATOL)
    assert mapper.expert.num_joints == mapper.to("panda").expert.num_joints == 7


@pytest.mark.slow
def test_joints_that_a_config_locks_are_locked_by_the_mask(mapper):
    """As in training."""
    described = describe_arm(mapper.env, mimic.ArmConfig(locked={"joint2": 0.4, "joint5": -0.3}))
    assert described.slots == mimic.panda().joint_names and list(described.joints) == [0, 2, 3, 5, 6]
    np.testing.assert_allclose(described.data.home[[1, 4]], [0.4, -0.3], rtol=1e-6)
    np.testing.assert_array_equal(described.data.is_free, [1, 0, 1, 1, 0, 1, 1, 0])


@pytest.mark.slow
@pytest.mark.parametrize("expert", [None, FOUR])
def test_the_distance_is_that_of_arms_whose_locked_joints_are_no_joints(mapper, expert):
    one = mapper.to(mimic.ArmConfig(locked={"joint2": 0.4, "joint5": -0.3}), expert)
    (qpos,) = poses(1, one.expert.num_joints)
    metric, learner_qpos = mapper.env.metric.build(one.expert, one.learner), one(qpos)
    expected = metric(mimic.link_states(one.expert, qpos), mimic.link_states(one.learner, learner_qpos))
    np.testing.assert_allclose(one.distance(jnp.asarray(qpos), learner_qpos), expected, rtol=1e-4)


@pytest.mark.slow
def test_the_nearest_pose_is_taken_and_locked_joints_stay(mapper):
    arm = lock_joints(mapper.arrays("panda"), np.eye(MAX_JOINTS)[3])
    (qpos,) = poses(1)
    target = mapper.model.pair(arm).target(jnp.append(qpos, 0.0))
    improved = mapper.model.improved(mapper.params, target)
    result = np.asarray(mapper(qpos, arm))
    np.testing.assert_allclose(result, improved[int(np.argmin(target.distances(improved)))], atol=1e-4)
    assert result.shape == (MAX_JOINTS,) and result[3] == arm.home[3] and result[7] == 0


@pytest.mark.slow
def test_empty_slots_of_an_expert_change_nothing(mapper):
    model, learner = mapper.model, mapper.arrays("panda")
    arm = mapper.arrays("panda3dof")
    is_empty = np.asarray(arm.link_length == 0)
    assert is_empty.any() and len(is_empty) == MAX_LINKS
    other = dataclasses.replace(arm, link_position=jnp.where(is_empty[:, None], 5.0, arm.link_position))
    for function in (model.candidates, model.improved):
        results = [function(mapper.params, model.pair(learner, each).target(each.home)) for each in (arm, other)]
        np.testing.assert_array_equal(*results)


@pytest.mark.slow
def test_a_batch_of_arms_is_mapped_by_vmap(mapper):
    arms = [lock_joints(mapper.arrays("panda"), row) for row in np.eye(MAX_JOINTS)[:3]]
    qpos = poses(2)
    batch = jax.vmap(mapper, (None, 0))(qpos, stack_arms(arms))
    for row, arm in zip(batch, arms, strict=True):
        np.testing.assert_allclose(row, mapper(qpos, arm), atol=ATOL)


@pytest.mark.slow
def test_each_sample_has_an_expert_and_a_learner_of_its_own(runs, mapper):
    keys = []

    def sampler(key):
        keys.append(key)
        return mapper.model.expert.data

    for model, count in ((mapper.model, 2), (mimic.PoseMapper.load(runs["fixed"]).model, 1)):
        keys.clear()
        params = jax.eval_shape(model.init, jax.random.key(0))
        distances = training.mapper_objective(model, sampler).distances
        shape = jax.eval_shape(distances, params, jax.random.split(jax.random.key(1), 3)).shape
        assert shape == (3, model.config.heads) and len(set(map(id, keys))) == count


@pytest.mark.slow
def test_motions_are_retargeted_to_any_learner(runs, tmp_path, own_registry):
    mimic.register("environment", "from_four", {"expert": FOUR, "learner": {"model": "panda"}})
    for name, run, joints in (("panda4dof", "fixed", 4), ("panda3dof", "fixed", 3), ("from_four", "drawn", 7)):
        env = mimic.make(name, demonstrations={"count": 2, "held_out": 1})
        expert, out = tmp_path / f"{name}.npz", tmp_path / f"{name}-mapped.npz"
        env.demonstrations.save(expert)
        config = RetargetConfig(demonstrations=str(expert), env=env_config(name), mapper=str(runs[run]), out=str(out))
        retarget.prepare_retargeting(config)()
        assert mimic.load_demonstrations(out).qpos.shape == (2, 51, joints)
    config = dataclasses.replace(config, mapper=str(runs["fixed"]), out=str(tmp_path / "new.npz"))
    with pytest.raises(ValueError, match="mapper: its expert is panda with joints"):
        retarget.prepare_retargeting(config)


@pytest.mark.slow
def test_training_reduces_the_loss():
    """Two hundred updates of the smallest network lower the distance of its proposals by a third."""
    config = run_config("", samples=6400, epochs=1, learning_rate=1e-2).resolve()
    settings, model = config.trainer, make_model(config.env, config.trainer)
    objective = training.mapper_objective(model, arm_sampler(config.env))
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
        random_distance=np.array([[1.1, 1.1]]),
        guessed_distance=np.array([[0.4, 0.3]]),
        guessed_qpos=np.zeros((1, 2, MAX_JOINTS)),
        home_distance=np.array([[0.5, 0.5]]),
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
    arm = lock_joints(mapper.model.expert.data, np.eye(MAX_JOINTS)[0])
    arm = dataclasses.replace(arm, home=np.full(MAX_JOINTS, 0.5))
    drawn = random_poses(arm, jax.random.key(0), (200,))
    assert np.all(drawn[:, 0] == 0.5) and np.all(drawn[:, 7] == 0.5)
    lower, upper = arm.joint_range[1:7].T
    assert np.all((drawn[:, 1:7] >= lower) & (drawn[:, 1:7] <= upper)) and np.ptp(drawn[:, 1]) > 5


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"preset": "large"}, "trainer.preset: expected any_arm or any_arm_cpu for a mapper to any arm"),
        ({"hidden_layers": [16]}, "trainer.hidden_layers: expected none for a mapper to any arm"),
        ({"width": 18}, "trainer.width: expected a multiple of 4, got 18"),
        ({"batch_size": 48}, "trainer.batch_size: expected a divisor of samples = 64, got 48"),
    ],
)
def test_settings_that_do_not_apply_are_rejected(settings, message):
    with pytest.raises(ValueError, match=message):
        run_config("", **settings).resolve()


def test_settings_of_any_arm_are_rejected_for_one_learner():
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


def test_a_fixed_expert_has_no_other(runs):
    fixed = mimic.PoseMapper.load(runs["fixed"])
    message = (
        "expert: expected none, because this mapper has a fixed one, panda; train one for any expert with env.arms"
    )
    for expert in ("panda4dof", FOUR, fixed.arrays("panda")):
        with pytest.raises(ValueError, match=message):
            fixed(np.zeros(4), "panda", expert)
    with pytest.raises(ValueError, match=message):
        fixed.to("panda", FOUR)
    # Its network has a token for each link of its expert, so that mappers of before keep their parameters.
    shapes = [
        jax.tree.map(np.shape, mimic.PoseMapper.load(run).params)["params"]["expert_place"] for run in runs.values()
    ]
    assert shapes == [(fixed.expert.num_links, 16), (MAX_LINKS, 16)]


@pytest.mark.usefixtures("unchecked")
def test_bad_arms_and_poses_are_rejected(mapper):
    arrays = mapper.arrays("panda")
    cases = [
        ((np.zeros(7),), r"learner: expected an arm, because this mapper takes any: mapper\(qpos, LEARNER\)"),
        ((np.zeros(6), "panda"), r"expected shape \[\.\.\., 7\]"),
        ((np.full(7, np.nan), "panda"), "expected finite angles"),
        ((np.zeros(7), "bimanual"), "expected a serial arm, got a tree of 2 chains"),
        ((np.zeros(7), "missing.xml"), "no MJCF or URDF file"),
        ((np.zeros(7), stack_arms([arrays] * 2)), "learner: expected arrays of one arm, .* use jax.vmap"),
        ((np.zeros(7), "panda", FOUR), r"expected shape \[\.\.\., 4\]"),
        ((np.zeros(7), "panda", arrays), r"qpos: expected shape \[\.\.\., 8\] for an expert as arrays, got \(7,\)"),
        ((np.full(8, np.nan), "panda", arrays), "qpos: expected finite angles"),
        ((np.zeros(7), "panda", "bimanual"), "expected a serial arm, got a tree of 2 chains"),
        ((np.zeros(8), "panda", stack_arms([arrays] * 2)), "expert: expected arrays of one arm, .* use jax.vmap"),
    ]
    for arguments, message in cases:
        with pytest.raises(ValueError, match=message):
            mapper(*arguments)


def test_a_mapper_is_loaded_for_the_arms_of_its_environment_or_others(runs, mapper):
    assert load_mapper(runs["drawn"], expert=FOUR).expert.num_joints == 4
    assert load_mapper(runs["fixed"]).learner.num_joints == 7
    assert mapper.takes_any_learner and mimic.AnyArmMapper.load is not None
    with pytest.raises(ValueError, match="learner: expected an arm"):
        _ = mapper.learner
