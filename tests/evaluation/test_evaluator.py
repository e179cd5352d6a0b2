"""The metrics of a controller on each demonstration, for controllers whose metrics are known."""

import copy
import csv
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import mimic
from mimic.envs.imitation import training_and_held_out
from mimic.evaluation import plots, references
from mimic.evaluation.evaluator import Evaluator, Rollouts
from mimic.evaluation.rollout_metrics import gap_interval, gaps, has_gap, measure
from mimic.evaluation.tracking_controllers import run_controller
from mimic.metric.kinematics import link_state_table
from mimic.trainers.ppo.trainer import PPOTrainer
from tests.helpers.metric_cases import planar_optimum
from tests.helpers.tiny import SHORT_ARMS

COUNT, HELD_OUT, HORIZON = 5, 4, 30
SPLITS = {"train": slice(0, COUNT), "held_out": slice(COUNT, None)}
LINKS = {"link_lengths": [0.6, 0.4]}


def make_evaluator(name="planar4dof", count=COUNT, held_out=HELD_OUT, **settings):
    config = mimic.env_config(name, demonstrations={"count": count, "held_out": held_out}, **settings)
    training, others = training_and_held_out(config)
    return Evaluator(mimic.ImitationEnv(config, training), others)


@pytest.fixture(scope="module")
def evaluator():
    """For an arm that imitates an equal arm."""
    return make_evaluator(expert=LINKS, learner=LINKS, horizon=HORIZON)


def rollouts(evaluator, turned=(0.0, 0.0), faster=(0.0, 0.0), distance=None):
    """The learner at the expert's joint angles and velocities plus offsets."""
    motions = evaluator.env.demonstrations
    qpos, qvel = (np.asarray(x[:, 1:], np.float32) for x in (motions.qpos + turned, motions.qvel + faster))
    distance = np.zeros(qpos.shape[:2]) if distance is None else distance
    return Rollouts(*(jnp.asarray(x, jnp.float32) for x in (qpos, qvel, 0 * qpos, distance)))


@pytest.mark.parametrize(
    ("by", "links"),
    [((0.0, 0.0), (0, 0)), ((0.3, 0.0), (0.3, 0.3)), ((0.0, -0.3), (0, 0.3)), ((0.3, -0.3), (0.3, 0))],
)
def test_errors_equal_a_known_rotation(evaluator, by, links):
    """An angle or velocity of a joint moves all distal links.

    0.05 deg: the arc cosine of float32 near 1; velocities of some rad/s are rounded by 1e-6.
    """
    turned = evaluator.table(rollouts(evaluator, turned=by))
    names = evaluator.env.learner.link_names
    for name, angle in zip(names, links, strict=True):
        np.testing.assert_allclose(turned[f"link_angle_error_deg.{name}"], np.degrees(angle), atol=0.05)
    np.testing.assert_allclose(turned["link_angle_error_deg"], np.degrees(np.mean(links)), atol=0.05)
    faster = evaluator.table(rollouts(evaluator, faster=by))
    np.testing.assert_allclose(faster["angular_velocity_error"], np.mean(links), atol=1e-5)
    assert np.all(faster["link_angle_error_deg"] < 0.05)


def test_angles_are_weighted_by_the_fraction_of_each_expert_link():
    """One learner link along x against expert links at 0 and at 90 degrees.

    By overlap W has 1 + 3/4 and 1 + 1/4, the fractions of the expert's links and of the learner's: 5/12 for the second.
    """
    config = mimic.env_config(
        "planar4dof",
        expert={"link_lengths": [0.75, 0.25]},
        learner={"link_lengths": [1.0]},
        demonstrations={"count": 1, "held_out": 1},
        horizon=1,
        metric={"correspondence": "overlap"},
    )
    motions = training_and_held_out(config)[0]
    motions.qpos[:], motions.qvel[:] = [0, np.pi / 2], [0, 2.0]
    evaluator = Evaluator(mimic.ImitationEnv(config, motions), motions)
    still = np.zeros((2, 1, 1))
    table = measure(evaluator.env, link_state_table(evaluator.env.learner, still, still), *(np.zeros((2, 1, 1)),) * 3)
    np.testing.assert_allclose(table["link_angle_error_deg"], 90 * 5 / 12, atol=0.05)
    np.testing.assert_allclose(table["angular_velocity_error"], 2 * 5 / 12, rtol=1e-5)


def test_torques_and_limits_by_hand(evaluator):
    env = copy.copy(evaluator.env)
    scale = np.asarray(env.torque_scale, float)
    env.learner = env.learner.replace(
        joint_range=np.array([[-1, 1], [-2, 2]]), velocity_limit=np.array([3.0, 4.0]), torque_limit=scale / 2
    )
    fraction = np.array([[0.0, 0.0], [0.5, 0.0], [1.0, -0.5]])  # of the maximum torques, over three steps
    qpos = np.array([[1.0, -2.0], [1.1, 0.0], [np.nan, 0.0]])
    qvel = np.array([[3.0, -4.1], [3.1, 4.1], [0.0, -4.0]])
    count = env.demonstrations.count
    motion = [np.broadcast_to(x, (count, 3, 2)) for x in (qpos, qvel, fraction * scale)]
    states = link_state_table(evaluator.env.learner, *(np.nan_to_num(x) for x in motion[:2]))
    table = measure(env, states, *motion)
    expected = {
        "torque_rms": np.sqrt((0.25 + 1 + 0.25) / 6),
        "torque_change": np.sqrt((0.25 + 0.25 + 0.25) / 4),
        "torque_saturation": 1 / 3,
        "position_violations": 2,  # at the stop is within it, not a number is not
        "speed_violations": 2,
        "torque_violations": 1,
    }
    for key, value in expected.items():
        np.testing.assert_allclose(table[key], np.full(count, value), rtol=1e-6)  # the maximum torques are in float32


def between(evaluator, fraction):
    """Rollouts with given optimality gaps, one for each demonstration."""
    bound, hold = evaluator.lower_bound, evaluator.hold_distance
    return rollouts(evaluator, distance=bound + np.asarray(fraction)[:, None] * (hold - bound))


def test_gaps_are_of_mean_distances(evaluator):
    """1e-5: the distances of a rollout are float32."""
    gap = np.random.default_rng(0).uniform(0, 1, COUNT + HELD_OUT)
    ran = between(evaluator, gap)
    np.testing.assert_allclose(evaluator.table(ran)["optimality_gap"], gap, rtol=1e-5)
    summary = evaluator.summary(ran)
    for split, part in SPLITS.items():
        distance, bound, hold = (
            x[part].mean() for x in (np.asarray(ran.distance), evaluator.lower_bound, evaluator.hold_distance)
        )
        assert summary["optimality_gap"][split] == pytest.approx((distance - bound) / (hold - bound), rel=1e-5)
        assert summary["optimality_gap"][split] != pytest.approx(gap[part].mean(), rel=1e-3)  # not the mean of ratios
        assert summary["mean_distance"][split] == pytest.approx(distance, rel=1e-5)


def test_a_summary_averages_but_counts_violations(evaluator):
    ran = rollouts(evaluator, faster=(100.0, 0.0))
    ran = dataclasses.replace(ran, torque=jnp.full_like(ran.torque, 0.5) * evaluator.env.torque_scale)
    summary = evaluator.summary(ran)
    assert summary["speed_violations"] == {"train": COUNT * HORIZON, "held_out": HELD_OUT * HORIZON}
    assert summary["torque_rms"] == pytest.approx({"train": 0.5, "held_out": 0.5}, rel=1e-6)


def test_the_worst_are_named_by_their_number_in_the_split(evaluator):
    worst = evaluator.worst(between(evaluator, [0.1, 0.5, 0.3, 0.2, 0.4, 0.6, 0.9, 0.7, 0.8]))
    assert {split: list(named) for split, named in worst.items()} == {
        "train": ["1", "4", "2"],
        "held_out": ["1", "3", "2"],
    }
    assert list(worst["held_out"].values()) == pytest.approx([0.9, 0.8, 0.7], rel=1e-5)


def test_similarity_of_a_turned_arm_is_in_the_report(evaluator):
    """Closed form: the second link, 0.4 of the chain, is rotated by 0.5 rad. Tolerances of float32."""
    summary = evaluator.similarity_summary(rollouts(evaluator, turned=(0.0, 0.5)), "policy")
    assert list(summary) == ["policy", "nearest_poses", "copy_joints", "hand_ik", "hold_home"]  # two links are no elbow
    expected = {
        "centre_line_distance": 0.4 * np.sin(0.25) * 0.4,
        "tangent_angle_deg": np.degrees(0.5) * 26 / 64,  # 26 of 64 samples lie on the second link
        "hand_position_error": 2 * np.sin(0.25) * 0.4,
        "hand_angle_deg": np.degrees(0.5),
    }
    for split in SPLITS:
        for key, value in expected.items():
            assert summary["policy"][key][split] == pytest.approx(value, rel=2e-3)  # 64 samples of the centre line
        for exact in ("nearest_poses", "copy_joints"):  # the learner is the expert's equal
            assert all(summary[exact][key][split] < 1e-5 for key in expected)
        assert summary["hold_home"]["centre_line_distance"][split] > 0.05
        assert summary["hand_ik"]["hand_position_error"][split] < 0.05  # interpolated between every fifth sample


def test_a_meaningless_gap_is_not_reported():
    distance, bound, hold = np.array([[0.2, 0.2, 0.0], [0.087, 0.075, 0.0], [0.101, 0.1, 0.0]])
    actual = gaps(distance, bound, hold)
    assert np.isnan(actual[[0, 2]]).all() and actual[1] == pytest.approx(5.0)
    assert has_gap(0.075, 0.1) and not has_gap(0.0751, 0.1)


def test_a_report_explains_a_missing_gap(evaluator, monkeypatch):
    """The bound is raised to where it saves less than a quarter of the distance of holding the start pose."""
    monkeypatch.setattr(Evaluator, "lower_bound", property(lambda evaluator: 0.9 * evaluator.hold_distance))
    ran = rollouts(evaluator, distance=2 * evaluator.hold_distance)
    figures = {**evaluator.summary(ran), "worst_demonstrations": evaluator.worst(ran)}
    figures["energy_distance"] = {"train": 0.1, "held_out": 0.2}
    assert all(np.isnan(gap) for gap in figures["optimality_gap"].values())
    assert figures["worst_demonstrations"] == {"train": {}, "held_out": {}}
    rows = PPOTrainer.rows(object.__new__(PPOTrainer), figures)
    assert rows[0] == ("optimality gap", "none", "none") and "saves less than" in rows[1][0]
    assert rows[2][0] == "mean distance" and float(rows[2][1]) > 0


def test_a_report_shows_that_the_gap_is_that_of_the_first_half(evaluator):
    """At the bound in the second half, and at twice the distance of holding before."""
    distance = np.array(evaluator.lower_bound)
    distance[:, : HORIZON // 2] = 2 * evaluator.hold_distance[:, : HORIZON // 2]
    ran = rollouts(evaluator, distance=distance)
    metrics = {**evaluator.summary(ran), "worst_demonstrations": evaluator.worst(ran), "energy_distance": {}}
    assert metrics["late_gap"] == pytest.approx(dict.fromkeys(SPLITS, 0.0), abs=1e-9)
    assert min(metrics["optimality_gap"].values()) > 0.1
    assert ("  in the second half", "0.00%", "0.00%") in PPOTrainer.rows(object.__new__(PPOTrainer), metrics)
    metrics["late_gap"] = metrics["optimality_gap"]
    assert all("second half" not in row[0] for row in PPOTrainer.rows(object.__new__(PPOTrainer), metrics))


def test_the_table_as_a_file(evaluator, tmp_path):
    ran = between(evaluator, np.linspace(0.1, 0.9, COUNT + HELD_OUT))
    evaluator.save_table(ran, tmp_path / "demonstrations.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["demonstrations.csv"]
    with (tmp_path / "demonstrations.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    numbers = [("train", str(i)) for i in range(COUNT)] + [("held_out", str(i)) for i in range(HELD_OUT)]
    assert [(row["split"], row["demonstration"]) for row in rows] == numbers
    for key, values in {**evaluator.table(ran), **evaluator.similarity(ran.qpos)}.items():
        written = np.array([row[key] for row in rows], values.dtype)  # digits enough for its precision
        np.testing.assert_array_equal(written, values)


@pytest.mark.parametrize("plot", [plots.plot_quality, plots.plot_demonstrations])
def test_plots_show_all_values_and_name_the_controller(evaluator, monkeypatch, tmp_path, plot):
    """The held-out demonstrations are worse than the training ones, whose axes come first."""
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    ran = between(evaluator, [0.1] * COUNT + [3.0, 2.0, 1.0, 0.0])
    plot(evaluator, ran, tmp_path / "picture.png", controller="pd", title="env")
    (figure,) = figures
    assert figure.get_suptitle().startswith("env: pd")
    assert any(text.get_text().startswith("pd") for text in figure.legends[0].get_texts())
    for axes in figure.axes:
        low, high = axes.get_ylim()
        assert all(np.all((line.get_ydata() >= low) & (line.get_ydata() <= high)) for line in axes.lines)


def test_holding_the_start_pose_is_the_reference_of_the_gap(evaluator):
    """1e-6: float32, the same distances from another compiled function."""
    ran, setting = run_controller(evaluator, "hold")
    np.testing.assert_allclose(ran.distance, evaluator.hold_distance, atol=1e-6)
    assert setting == {"frequency_rad_s": 0} and not np.asarray(ran.torque).any()


def test_gaps_and_intervals_of_each_kind(evaluator):
    """The same gap everywhere has an interval of no width; 1e-5: distances of a rollout are float32."""
    gap = np.full(COUNT + HELD_OUT, 0.25)
    by_kind = evaluator.summary(between(evaluator, gap))["by_kind"]
    kinds = evaluator.env.demonstrations.kinds
    assert list(by_kind) == [*dict.fromkeys(kinds), "all"]
    for kind, splits in by_kind.items():
        for split, part in SPLITS.items():
            count = len(kinds[part]) if kind == "all" else kinds[part].count(kind)
            assert (split in splits) == (count > 0)
            if count:
                assert splits[split] == pytest.approx(
                    {"optimality_gap": 0.25, "low": 0.25, "high": 0.25, "demonstrations": count}, rel=1e-5
                )


def test_an_interval_covers_both_seeds_and_demonstrations():
    """With two seeds of gaps 0 and 1 a quarter of the resamples has only the one or the other: 0 and 1 are the ends."""
    bound, hold = np.zeros(50), np.ones(50)
    gap, low, high = gap_interval(np.stack([bound, hold]), bound, hold)
    assert (gap, low, high) == pytest.approx((0.5, 0.0, 1.0))
    # Of one seed the interval is that of a mean: 1.96 standard errors, with 3 % of Monte Carlo error and skewness.
    distance = np.random.default_rng(0).normal(0.5, 0.1, (1, 400))
    gap, low, high = gap_interval(distance, np.zeros(400), np.ones(400))
    assert gap == pytest.approx(distance.mean())
    assert [low, high] == pytest.approx([gap - 0.0098, gap + 0.0098], abs=5e-4)
    assert np.isnan(gap_interval(distance, np.ones(400), np.ones(400))).all()


def test_controllers_that_know_the_dynamics_copy_an_equal_arm(evaluator):
    """The bound is 0, and each torque of the expert can be found again; 1e-4: float32."""
    copied, inverted = (run_controller(evaluator, name)[0] for name in ("copy_joints", "one_step"))
    for split in SPLITS:
        assert evaluator.summary(inverted)["optimality_gap"][split] < 1e-4
        assert evaluator.summary(copied)["optimality_gap"][split] < 3e-3


@pytest.mark.slow
def test_model_prediction_is_near_the_bound():
    """Two links that imitate three, of which it sees the next step. 0.06 % by measurement."""
    evaluator = make_evaluator(count=2, held_out=2, **SHORT_ARMS, horizon=2 * HORIZON)
    ahead = evaluator.summary(run_controller(evaluator, "mpc")[0])["optimality_gap"]
    assert max(ahead.values()) < 2e-3


def test_another_horizon_repeats_the_last_sample(evaluator):
    longer = evaluator.env.with_horizon(HORIZON + 3)
    assert longer.config.horizon == HORIZON + 3
    np.testing.assert_array_equal(longer.expert_states.position[:, -1], evaluator.env.expert_states.position[:, -1])


@pytest.mark.slow
def test_exact_dynamics_track_better_than_none(evaluator):
    feedback, exact = (run_controller(evaluator, name)[0] for name in ("pd", "computed_torque"))
    actual = [evaluator.summary(ran)["optimality_gap"] for ran in (exact, feedback)]
    for split in SPLITS:
        # 1.3e-3 by measurement: a torque is held for 0.1 s while the dynamics go on, and near a match the distance of
        # positions grows with the error itself, not with its square.
        assert actual[0][split] < 3e-3
        assert 5 * actual[0][split] < actual[1][split] < 0.1  # it does without the coupling of joints


def test_actions_out_of_range_get_the_maximum_torque(evaluator):
    greedy = jax.jit(lambda: evaluator.rollout(lambda state: jnp.array([5.0, -5.0])))()
    scale = np.asarray(evaluator.env.torque_scale)
    np.testing.assert_array_equal(greedy.torque, np.broadcast_to(scale * [1, -1], greedy.torque.shape))


def test_the_bound_of_an_equal_arm_needs_no_search(monkeypatch):
    monkeypatch.setattr(references, "closest_motion", None)  # would fail
    evaluator = make_evaluator("panda7dof", 2, 1)
    assert evaluator.lower_bound.shape == evaluator.hold_distance.shape == (3, 50)
    assert not evaluator.lower_bound.any() and evaluator.hold_distance[:, -1].min() > 0.01


@pytest.mark.slow
def test_no_rollout_goes_below_the_bound():
    """Random controllers on the planar arm. 1e-4: the tolerance of the search."""
    evaluator = make_evaluator(count=3, held_out=2, **SHORT_ARMS, horizon=HORIZON)
    rollout = jax.jit(lambda gain: evaluator.rollout(lambda state: gain @ state.obs))
    size = evaluator.env.action_size, evaluator.env.observation_size
    for seed in range(5):
        gain = np.random.default_rng(seed).normal(size=size) * 0.02 * seed
        assert np.all(np.asarray(rollout(gain).distance) > evaluator.lower_bound - 1e-4)


def test_one_demonstration_has_the_references_that_it_has_among_all(evaluator):
    one = evaluator.only(COUNT + 1)
    assert len(one.lower_bound) == 1 and one.parts["held_out"] == slice(0, 1)
    np.testing.assert_array_equal(one.lower_bound[0], evaluator.lower_bound[COUNT + 1])
    np.testing.assert_allclose(one.hold_distance[0], evaluator.hold_distance[COUNT + 1], rtol=1e-5)  # float32


def test_bound_and_hold_distance_belong_to_the_samples_after_each_step():
    """Closed forms for the directions of planar arms. 1e-4: the tolerance of the search."""
    metric = {"correspondence": "overlap", "translation": 0.0, "linear_velocity": 0.0, "angular_velocity": 0.0}
    metric |= {"hand_rotation": 0.0}
    evaluator = make_evaluator(count=1, held_out=1, **SHORT_ARMS, horizon=12, metric=metric)
    env = evaluator.env
    optimum = planar_optimum(env.expert, env.learner, env.demonstrations.qpos)
    np.testing.assert_allclose(evaluator.lower_bound, optimum[:, 1:], atol=1e-4)
    assert np.abs(np.diff(optimum, axis=1)).max() > 5e-3  # a bound one sample early would be noticed
    weights, angles = np.asarray(env.metric.correspondence), np.cumsum(env.demonstrations.qpos, axis=-1)
    straight = np.pi / 2 * (weights.sum() - (np.cos(angles) @ weights).sum(axis=-1)) / weights.size
    np.testing.assert_allclose(evaluator.hold_distance, straight[:, 1:], atol=1e-5)  # float32
