"""The evaluation of many arms: gaps of chosen rollouts, splits and tables; and the real rollouts and bounds."""

import csv
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mimic.arms.arrays import MAX_JOINTS
from mimic.envs.family import SEEN, UNSEEN, report_arms
from mimic.envs.make import make_env
from mimic.evaluation.evaluator import Evaluator, Rollouts
from mimic.evaluation.references import CONTROLLER, References
from tests.helpers.untrained_run import FAMILY, family

HORIZON, HELD_OUT = FAMILY["horizon"], FAMILY["demonstrations"]["held_out"]
NAMES = ["whole", "locked 1", "locked 7", *(f"locked {i}" for i in (2, 3, 4, 5, 6))]


@pytest.fixture(scope="module")
def env():
    return make_env(family())


def unused() -> Any:
    raise AssertionError("the bound was searched")


def rollouts(distance: Any) -> Rollouts:
    """Rollouts at rest in the zero pose of constant distance, a number for each arm."""
    by_row: Any = np.repeat(np.asarray(distance, np.float32), HELD_OUT)[:, None]
    still: Any = np.zeros((len(by_row), HORIZON, MAX_JOINTS), np.float32)
    return Rollouts(still, still, still, still[..., 0] + by_row)


def evaluator_of(env, arms, bound):
    """With these bounds of the arms, and a distance of holding of 1."""
    evaluator: Any = Evaluator(env, env.held_out, arms, unused)
    controller: Any = rollouts([0.28] * 7 + [0.9])
    bounds = np.minimum(rollouts(bound).distance, controller.distance)
    motions: Any = dict.fromkeys((CONTROLLER, "nearest_poses", "hold_home"), controller.qpos)
    references = References(bounds, np.ones_like(bounds), motions, controller.distance)
    evaluator._references = lambda: references
    return evaluator


@pytest.fixture(scope="module")
def arms(env):
    return report_arms(env.config)


@pytest.fixture(scope="module")
def evaluator(env, arms):
    """The last arm's best motion saves a tenth of the distance of holding."""
    return evaluator_of(env, arms, [0.2] * 7 + [0.9])


OUTCOME = rollouts([0.2, 0.28, 0.36, 0.6, 0.1, 0.2, 0.2, 0.95])


def test_gaps_are_those_of_the_means_and_bounds_are_lowered_to_rollouts(evaluator):
    table = evaluator.by_arm(evaluator.table(OUTCOME))
    assert [group.arm for group in evaluator.groups] == NAMES
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


def test_a_split_without_arms_is_left_out(env, arms):
    evaluator = evaluator_of(env, {SEEN: {**arms[SEEN], **arms[UNSEEN]}, UNSEEN: {}}, [0.2] * 8)
    assert all(values.keys() == {"train"} for values in evaluator.summary(OUTCOME).values())
    assert evaluator.similarity_summary(OUTCOME, "policy")["policy"]["tangent_angle_deg"].keys() == {"train"}


def test_details_and_tables(evaluator, tmp_path):
    details = evaluator.details(OUTCOME)
    assert list(details) == NAMES and [arm["seen"] for arm in details.values()] == [True] * 3 + [False] * 5
    assert [arm["joints"] for arm in details.values()] == [7, *[6] * 7]
    evaluator.save_arms(OUTCOME, tmp_path / "arms.csv")
    with (tmp_path / "arms.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["arm"] for row in rows] == NAMES and [row["arms"] for row in rows][2:4] == ["seen", "unseen"]


def test_similarity_of_the_home_pose_is_that_of_holding(evaluator):
    """All rollouts rest at home here, where the whole Panda's expert starts too; so they and holding agree."""
    similarity = evaluator.similarity_summary(OUTCOME, "policy")
    assert list(similarity) == ["policy", CONTROLLER, "nearest_poses", "hold_home"]
    assert similarity["policy"] == similarity["hold_home"]
    assert list(evaluator.similarity_summary(OUTCOME, "nearest_pose")) == ["nearest_pose", "nearest_poses", "hold_home"]


def test_arms_have_different_names(env, arms):
    for twice in ({SEEN: arms[SEEN], UNSEEN: arms[SEEN]}, {SEEN: {}, UNSEEN: {}}):
        with pytest.raises(ValueError, match="arms: expected arms of different names in the report, got "):
            Evaluator(env, env.held_out, twice, unused)


def test_speed_limits_are_those_of_each_arm(evaluator):
    """Joint 2 is locked in the fourth arm alone; one of five steps is too fast."""
    qvel = np.zeros_like(OUTCOME.qvel)
    qvel[:, 2, 1] = 2.2  # rad/s; the limit is 2.175
    fast = evaluator.by_arm(evaluator.table(dataclasses.replace(OUTCOME, qvel=qvel)))["speed_violations"]
    np.testing.assert_allclose(fast, np.where(np.array(NAMES) == "locked 2", 0, 1 / HORIZON))


@pytest.mark.slow
def test_the_zero_action_is_near_the_bound_of_each_arm(env, arms):
    zeros = jnp.zeros(env.action_size)
    evaluator = Evaluator(env, env.held_out, arms, lambda: controller)
    controller = jax.device_get(jax.jit(lambda: evaluator.rollout(lambda state: zeros))())
    assert controller.qpos.shape == (len(NAMES) * HELD_OUT, HORIZON, MAX_JOINTS)
    assert not controller.qpos[2 * HELD_OUT : 3 * HELD_OUT, :, 6].any()  # joint 7 is locked in the third arm
    # The search ends up to 2e-4 above the minimum, see `mimic.retargeting.array_bound`.
    assert np.all(evaluator.lower_bound <= controller.distance + 5e-4)
    table = evaluator.by_arm(evaluator.table(controller))
    assert np.all(table["gap"] >= 0) and np.all(table["gap"] < 0.2)
    np.testing.assert_array_equal(table["gap"], table["controller_gap"])
