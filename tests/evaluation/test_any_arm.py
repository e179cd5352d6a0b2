"""The evaluation of many arms: gaps of chosen rollouts, splits, tables and plots; and the real rollouts and bounds."""

import csv
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from mimic.arms.arrays import MAX_JOINTS
from mimic.envs.family import SEEN, UNSEEN, arm_sampler, report_arms
from mimic.envs.imitation import training_and_held_out
from mimic.envs.many_arms import AnyArmEnv
from mimic.evaluation.any_arm import ArmReferences, ArmRollouts, ArmsEvaluator, ArmsOutcome
from mimic.evaluation.plots import plot_arms
from tests.helpers.untrained_family import HELD_OUT, HORIZON, family

NAMES = ["whole", "locked 1", "locked 7", *(f"locked {i}" for i in (2, 3, 4, 5, 6))]


@pytest.fixture(scope="module")
def env():
    config = family()
    return AnyArmEnv(config, arm_sampler(config), training_and_held_out(config)[1])


def unused() -> Any:
    raise AssertionError("the bound was searched")


def rollouts(distance: Any, qpos: Any = None) -> ArmRollouts:
    """Rollouts of constant distance, a number for each arm."""
    shape = len(NAMES), HELD_OUT, HORIZON
    distance = np.broadcast_to(np.asarray(distance, np.float32)[:, None, None], shape)
    qpos = np.zeros((*shape, MAX_JOINTS), np.float32) if qpos is None else qpos
    return ArmRollouts(qpos, np.zeros(shape, np.float32), distance)


@pytest.fixture
def evaluator(env, monkeypatch):
    """With bounds of 0.2 and a distance of holding of 1; the last arm's best motion saves a tenth of that."""
    evaluator = ArmsEvaluator(env, report_arms(env.config), unused)
    bound = rollouts([0.2] * 7 + [0.9]).distance
    references = ArmReferences(bound, np.ones_like(bound), rollouts(np.zeros(8)).qpos)
    monkeypatch.setattr(evaluator, "_references", lambda: references)
    return evaluator


OUTCOME = ArmsOutcome(rollouts([0.2, 0.28, 0.36, 0.6, 0.1, 0.2, 0.2, 0.95]), rollouts([0.28] * 7 + [0.9]))


def test_gaps_are_those_of_the_means_and_bounds_are_lowered_to_rollouts(evaluator):
    table = evaluator.table(OUTCOME)
    assert evaluator.names == NAMES and table["joints"].tolist() == [7, *[6] * 7]
    np.testing.assert_allclose(table["gap"][:5], [0, 0.1, 0.2, 0.5, 0], atol=1e-6)
    np.testing.assert_allclose(table["controller_gap"][:5], [0.1, 0.1, 0.1, 0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(table["lower_bound"][4], 0.1, atol=1e-6)
    assert np.isnan(table["gap"][-1]) and table["span"][-1] == pytest.approx(0.1)


def test_the_summary_is_of_arms_with_a_gap(evaluator):
    summary = evaluator.summary(OUTCOME)
    assert summary["optimality_gap"] == pytest.approx({"train": 0.1, "held_out": 0.125}, abs=1e-6)
    assert summary["median_gap"] == pytest.approx({"train": 0.1, "held_out": 0.0}, abs=1e-6)
    assert summary["largest_gap"] == pytest.approx({"train": 0.2, "held_out": 0.5}, abs=1e-6)
    assert summary["controller_gap"] == pytest.approx({"train": 0.1, "held_out": 0.125}, abs=1e-6)
    assert summary["hold_distance"] == pytest.approx({"train": 1, "held_out": 1})


def test_a_split_without_arms_is_left_out(env, monkeypatch):
    arms = report_arms(env.config)
    evaluator = ArmsEvaluator(env, {SEEN: {**arms[SEEN], **arms[UNSEEN]}, UNSEEN: {}}, unused)
    bound = rollouts([0.2] * 8).distance
    references = ArmReferences(bound, np.ones_like(bound), rollouts(np.zeros(8)).qpos)
    monkeypatch.setattr(evaluator, "_references", lambda: references)
    assert all(values.keys() == {"train"} for values in evaluator.summary(OUTCOME).values())
    assert evaluator.similarity_summary(OUTCOME, "policy")["policy"]["tangent_angle_deg"].keys() == {"train"}


def test_details_tables_and_plots(evaluator, tmp_path):
    details = evaluator.details(OUTCOME)
    assert list(details) == NAMES and [arm["seen"] for arm in details.values()] == [True] * 3 + [False] * 5
    assert details["whole"]["joints"] == 7 and isinstance(details["whole"]["joints"], int)
    evaluator.save_table(OUTCOME, tmp_path / "arms.csv")
    with (tmp_path / "arms.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["arm"] for row in rows] == NAMES and [row["arms"] for row in rows][2:4] == ["seen", "unseen"]
    options: Any = {"series": {"gap": "policy", "controller_gap": "none"}, "label": "gap [%]", "title": "family"}
    plot_arms(details, out=tmp_path / "arms.png", **options)
    assert min(Image.open(tmp_path / "arms.png").size) > 300
    plot_arms({}, out=tmp_path / "none.png", **options)
    assert not (tmp_path / "none.png").exists()


def test_similarity_of_the_home_pose_is_that_of_holding(evaluator):
    """All rollouts rest at home here, where the whole Panda's expert starts too; so they and holding agree."""
    similarity = evaluator.similarity_summary(OUTCOME, "policy")
    assert list(similarity) == ["policy", "controller", "nearest_poses", "hold_home"]
    assert similarity["policy"] == similarity["hold_home"]
    assert list(evaluator.similarity_summary(OUTCOME, "nearest_pose")) == ["nearest_pose", "nearest_poses", "hold_home"]


def test_arms_have_different_names(env):
    arms = report_arms(env.config)
    with pytest.raises(ValueError, match="arms: expected arms of different names in the report, got whole, "):
        ArmsEvaluator(env, {SEEN: arms[SEEN], UNSEEN: arms[SEEN]}, unused)
    with pytest.raises(ValueError, match="arms: expected"):
        ArmsEvaluator(env, {SEEN: {}, UNSEEN: {}}, unused)


@pytest.mark.slow
def test_the_zero_action_is_near_the_bound_of_each_arm(env):
    holder = {}
    evaluator = ArmsEvaluator(env, report_arms(env.config), lambda: holder["controller"])
    run = jax.jit(lambda: evaluator.rollout(lambda state: jnp.zeros(env.action_size)))
    holder["controller"] = controller = jax.device_get(run())
    assert controller.qpos.shape == (len(NAMES), HELD_OUT, HORIZON, MAX_JOINTS)
    locked = 1 - np.asarray(evaluator.arms.is_free)
    assert not (controller.qpos * locked[:, None, None]).any()
    references = evaluator.references()
    # The search ends up to 2e-4 above the minimum, see `mimic.retargeting.array_bound`.
    assert np.all(references.bound <= controller.distance + 5e-4)
    table = evaluator.table(ArmsOutcome(controller, controller))
    assert np.all(table["gap"] >= 0) and np.all(table["gap"] < 0.2)
    np.testing.assert_array_equal(table["gap"], table["controller_gap"])
