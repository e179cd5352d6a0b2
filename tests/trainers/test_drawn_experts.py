"""The pose mapper from any arm to any arm: experts that are drawn, named by a caller, or of the report."""

import csv
import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mimic
from mimic.arms.arrays import MAX_JOINTS, MAX_LINKS, stack_arms
from mimic.commands import retarget
from mimic.commands.config import RetargetConfig
from mimic.envs import env_config
from mimic.runs.checkpoints import save_checkpoint
from mimic.trainers import run_training as session
from mimic.trainers.config import PoseMapperConfig, TrainConfig
from mimic.trainers.pose_mapper.any_arm_evaluation import METHODS
from mimic.trainers.pose_mapper.any_arm_mapper import AnyArmMapper, load_mapper
from mimic.trainers.pose_mapper.any_arm_model import expert_pose, make_any_arm_model
from mimic.trainers.pose_mapper.any_arm_training import any_arm_objective
from mimic.trainers.run_config import save_config

TINY: dict[str, Any] = {
    "width": 16, "layers": 1, "heads": 2, "guesses": 1, "refinements": 1, "samples": 64, "batch_size": 32, "epochs": 1,
    "evaluations": 1, "validation_poses": 8, "held_out_poses": 2,
}  # fmt: skip
DRAWN = {"expert": "drawn", "locked_fraction": 1.0, "most_locked": 1, "unseen": ["2", "5", "1+4"]}
FOUR = mimic.ArmConfig(locked=[3, 6, 7])
ATOL = 1e-3  # rad: a Newton step magnifies rounding errors


def untrained_run(run_dir, expert):
    env = env_config("panda_family", arms={**DRAWN, "expert": expert})
    config = PoseMapperConfig(**TINY).resolve(env=env)
    run_dir.mkdir()
    save_config(run_dir, TrainConfig(env, config))
    shapes, rng = jax.eval_shape(make_any_arm_model(env, config).init, jax.random.key(0)), np.random.default_rng(0)
    save_checkpoint(run_dir, 1, jax.tree.map(lambda x: rng.normal(0, 0.2, x.shape).astype(x.dtype), shapes))
    return run_dir


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return {expert: untrained_run(folder / expert, expert) for expert in ("fixed", "drawn")}


@pytest.fixture(scope="module")
def mapper(runs):
    return AnyArmMapper.load(runs["drawn"])


def poses(count, joints, seed=0):
    return np.random.default_rng(seed).uniform(-2, 2, (count, joints)).astype(np.float32)


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


@pytest.mark.slow
def test_the_expert_is_that_of_the_environment_by_default(mapper):
    qpos = poses(3, 7)
    np.testing.assert_allclose(mapper(qpos, FOUR), mapper(qpos, FOUR, "panda"), atol=ATOL)
    assert mapper.expert == mapper.own_expert.arm.embodiment and mapper.to("panda").expert.num_joints == 7


@pytest.mark.slow
def test_the_distance_is_that_of_both_arms(mapper):
    one, (qpos,) = mapper.to("panda3dof", FOUR), poses(1, 4)
    metric = mapper.env.metric.build(one.expert, one.learner)
    assert (one.expert.num_joints, one.learner.num_joints) == (4, 3)
    learner_qpos = one(qpos)
    expected = metric(mimic.link_states(one.expert, qpos), mimic.link_states(one.learner, learner_qpos))
    np.testing.assert_allclose(one.model.distance(jnp.asarray(qpos), learner_qpos), expected, rtol=1e-4)


@pytest.mark.slow
def test_empty_slots_of_an_expert_change_nothing(mapper):
    model, learner = mapper.model, mapper.arrays("panda")
    arm = mapper.arrays("panda3dof")
    is_empty = np.asarray(arm.link_length == 0)
    assert is_empty.any() and len(is_empty) == MAX_LINKS
    other = dataclasses.replace(arm, link_position=jnp.where(is_empty[:, None], 5.0, arm.link_position))
    for function in (model.candidates, model.refined):
        results = [function(mapper.params, expert_pose(each, each.home), learner) for each in (arm, other)]
        jax.tree.map(np.testing.assert_array_equal, *results)


@pytest.mark.slow
def test_each_sample_has_an_expert_and_a_learner_of_its_own(runs, mapper):
    keys = []

    def sampler(key):
        keys.append(key)
        return mapper.model.expert

    for model, count in ((mapper.model, 2), (AnyArmMapper.load(runs["fixed"]).model, 1)):
        keys.clear()
        params = jax.eval_shape(model.init, jax.random.key(0))
        distances = any_arm_objective(model, sampler).distances
        shape = jax.eval_shape(distances, params, jax.random.split(jax.random.key(1), 3)).shape
        assert shape == (3, model.heads) and len(set(map(id, keys))) == count


def test_a_fixed_expert_has_no_other(runs):
    fixed = AnyArmMapper.load(runs["fixed"])
    message = (
        "expert: expected none, because this mapper has a fixed one, panda; train one for any expert with env.arms"
    )
    for expert in ("panda4dof", FOUR, fixed.arrays("panda")):
        with pytest.raises(ValueError, match=message):
            fixed(np.zeros(4), "panda", expert)
    with pytest.raises(ValueError, match=message):
        fixed.to("panda", FOUR)
    # Its network has a token for each link of its expert, so that mappers of before keep their parameters.
    shapes = [jax.tree.map(np.shape, AnyArmMapper.load(run).params)["params"]["expert_place"] for run in runs.values()]
    assert shapes == [(fixed.expert.num_links, 16), (MAX_LINKS, 16)]


@pytest.mark.usefixtures("unchecked")
def test_bad_experts_and_poses_are_rejected(mapper):
    arrays = mapper.arrays("panda")
    cases = [
        ((np.zeros(7), "panda", FOUR), r"expected shape \[\.\.\., 4\]"),
        ((np.zeros(7), "panda", arrays), r"qpos: expected shape \[\.\.\., 8\] for an expert as arrays, got \(7,\)"),
        ((np.full(8, np.nan), "panda", arrays), "qpos: expected finite angles"),
        ((np.zeros(7), "panda", "bimanual"), "expected a serial arm, got a tree of 2 chains"),
        ((np.zeros(8), "panda", stack_arms([arrays] * 2)), "expert: expected arrays of one arm, .* use jax.vmap"),
    ]
    for arguments, message in cases:
        with pytest.raises(ValueError, match=message):
            mapper(*arguments)


@pytest.mark.slow
def test_the_report_has_pairs_of_other_arms(tmp_path):
    env = env_config("panda_family", arms=DRAWN)
    config = TrainConfig(env, PoseMapperConfig(**TINY), run_dir=str(tmp_path / "run"), compilation_cache="")
    assert session.prepare_training(config, 0.0)() == 0
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert list(report["arms"]) == [
        "whole",
        *(f"locked {i}" for i in (1, 3, 4, 6, 7)),
        "locked 2",
        "locked 5",
        "locked 1+4",
    ]
    names = list(report["pairs"])
    assert names[:2] == ["locked 7 to whole", "whole to locked 1"] and names[6] == "locked 1+4 to locked 2"
    for key in (*METHODS, "quality_largest", "optimal_distance"):
        assert set(report["other_experts"][key]) == {"train", "held_out"}
    seen = [pair["quality"] for pair in report["pairs"].values() if pair["seen"]]
    assert report["other_experts"]["quality"]["train"] == pytest.approx(np.mean(seen)) and len(seen) == 6
    with (tmp_path / "run" / "pairs.csv").open() as file:
        assert [row["arm"] for row in csv.DictReader(file)] == names


@pytest.mark.slow
def test_motions_of_other_experts_are_retargeted(runs, tmp_path, own_registry):
    mimic.register("environment", "from_four", {"expert": FOUR, "learner": {"model": "panda"}})
    env = mimic.make("from_four", demonstrations={"count": 2, "held_out": 1})
    env.demonstrations.save(tmp_path / "expert.npz")
    config = RetargetConfig(
        str(tmp_path / "expert.npz"), env_config("from_four"), str(runs["drawn"]), out=str(tmp_path / "learner.npz")
    )
    retarget.prepare_retargeting(config)()
    assert mimic.load_demonstrations(tmp_path / "learner.npz").qpos.shape == (2, 51, 7)
    with pytest.raises(ValueError, match="mapper: its expert is panda with joints"):
        retarget.prepare_retargeting(
            dataclasses.replace(config, mapper=str(runs["fixed"]), out=str(tmp_path / "new.npz"))
        )
    assert load_mapper(runs["drawn"], expert=FOUR).expert.num_joints == 4
