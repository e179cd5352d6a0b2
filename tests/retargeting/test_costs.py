"""Costs of retargeting: closed forms, finite differences, C MuJoCo's distances, and what each does to the result."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mimic.arms.arm import ArmConfig, arm_spec
from mimic.arms.capsules import Capsules, fit_capsules
from mimic.arms.embodiment import panda, planar_arm
from mimic.control.clearance import segment_distances
from mimic.metric.capsule_distances import capsule_axes, pair_distances
from mimic.metric.config import MetricConfig
from mimic.retargeting.costs import (
    Costs,
    hand_cost,
    home_cost,
    limit_cost,
    pose_cost,
    smoothness_derivatives,
)
from mimic.retargeting.pose import imitate_pose
from mimic.retargeting.pose_objective import automatic_derivatives
from mimic.retargeting.trajectory import imitate_trajectory

EXPERT, LEARNER = planar_arm([0.4, 0.35, 0.25]), planar_arm([0.6, 0.4])
METRIC = MetricConfig().build(EXPERT, LEARNER).arguments
FEW: dict[str, Any] = {"starts": 3}
QPOS = np.random.default_rng(0).uniform(-2, 2, (6, 3)).astype(np.float32)


def test_segment_distances_equal_those_of_mujoco(x64):
    """Two capsules in random positions; parallel ones and ends too."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body mocap="true"><geom type="capsule" size="0.01 0.3"/></body>'
        '<body mocap="true"><geom type="capsule" size="0.02 0.1"/></body></worldbody></mujoco>'
    )
    data, rng, compared = mujoco.MjData(model), np.random.default_rng(0), 0
    distance = jax.jit(lambda *ends: segment_distances(*ends, jnp, smoothing=1e-4))
    for trial in range(300):
        data.mocap_pos[:] = rng.normal(size=(2, 3)) * 0.4
        data.mocap_quat[:] = rng.normal(size=(2, 4))
        if trial % 3 == 0:
            data.mocap_quat[1] = data.mocap_quat[0]
        data.mocap_quat /= np.linalg.norm(data.mocap_quat, axis=1, keepdims=True)
        mujoco.mj_kinematics(model, data)
        axes = [half * data.geom_xmat[i].reshape(3, 3)[:, 2] for i, half in enumerate((0.3, 0.1))]
        ends = [data.geom_xpos[i] + sign * axes[i] for i in (0, 1) for sign in (-1, 1)]
        theirs = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)
        if theirs > 0:  # MuJoCo measures the depth of an intersection along another direction
            compared += 1
            assert float(distance(*ends)) - 0.03 == pytest.approx(theirs, abs=1e-6)
    assert compared > 250


def capsule_model(height, thicker):
    """The Panda as a C MuJoCo model with the shapes of `fit_capsules`, thicker [m], above a floor at a height."""
    spec = arm_spec(ArmConfig())
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], pos=[0, 0, height])
    model = spec.compile()
    cylinders = model.geom_type == int(mujoco.mjtGeom.mjGEOM_CYLINDER)
    radius, half = model.geom_size[cylinders, 0], model.geom_size[cylinders, 1]
    model.geom_size[cylinders, 1] = np.maximum(
        half - radius, 0
    )  # of the axis, at whose ends a capsule has half spheres
    model.geom_type[cylinders] = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
    model.geom_size[model.geom_type == int(mujoco.mjtGeom.mjGEOM_CAPSULE), 0] += thicker
    return model


def test_penetrations_of_a_panda_equal_those_of_mujoco(x64):
    """Random poses of a thick Panda: the depth of each pair, and both costs from the distances of C MuJoCo."""
    arm, height, thicker, clearance = panda(limits="hardware"), 0.3, 0.03, 0.05
    capsules = fit_capsules(ArmConfig(), "hardware")
    capsules = dataclasses.replace(capsules, radius=capsules.radius + thicker)
    model = capsule_model(height, thicker)
    data, floor = mujoco.MjData(model), model.geom("floor").id
    geoms = [geom for geom in range(model.ngeom) if geom != floor]
    pairs = [(geoms[i], geoms[j]) for i, j in capsules.pairs]
    pairs += [(floor, geom) for geom, joint in zip(geoms, capsules.joint, strict=True) if joint > 0]
    lower, upper = np.asarray(arm.joint_range, float).T
    qpos = np.random.default_rng(0).uniform(lower, upper, (150, 7))
    theirs = np.empty((len(qpos), len(pairs)))
    for row, q in zip(theirs, qpos, strict=True):
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        row[:] = [mujoco.mj_geomDistance(model, data, a, b, 10.0, None) for a, b in pairs]
    costs = Costs(self_collision=1.0, clearance=clearance), Costs(floor=1.0, clearance=clearance, floor_height=height)

    @jax.jit
    @jax.vmap
    def ours(q):
        distances = pair_distances(capsules, *capsule_axes(arm, capsules, q))
        return distances, *(pose_cost(cost, arm, arm, capsules, q, q) for cost in costs)

    distances, *values = ours(qpos)
    between, above = np.split(theirs, [len(capsules.pairs)], axis=1)
    assert np.sum(between < 0) > 40 and np.sum(above < 0) > 100
    np.testing.assert_allclose(distances, between, atol=2e-6)  # m; the smoothing of axes that nearly cross
    for value, distance in zip(values, (between, above), strict=True):
        intrusion = np.sum(np.maximum(0, 1 - distance / clearance) ** 2, axis=1)
        np.testing.assert_allclose(value, intrusion, rtol=1e-3, atol=1e-4)


def test_closed_forms():
    """Hand, home and limits of planar arms, whose geometry is plain trigonometry."""
    expert, learner = planar_arm([1.0]), planar_arm([0.5, 0.5])
    q, p = jnp.array([0.3]), jnp.array([0.5, -0.9])
    tips = [np.array([np.cos(0.3), np.sin(0.3)]), np.zeros(2)]
    tips[1] = 0.5 * np.array([np.cos(0.5), np.sin(0.5)]) + 0.5 * np.array([np.cos(-0.4), np.sin(-0.4)])
    expected = np.sum((tips[0] - tips[1]) ** 2)
    assert float(hand_cost(expert, learner, q, p)) == pytest.approx(expected, rel=1e-5)
    bounded = dataclasses.replace(learner, joint_range=np.array([[-1.0, 1.0], [-2.0, 2.0]]), home=np.array([0.1, 0.2]))
    assert float(home_cost(bounded, p)) == pytest.approx(((0.4 / 1) ** 2 + (1.1 / 2) ** 2) / 2, rel=1e-5)
    assert float(home_cost(learner, p)) == pytest.approx(np.mean(2 * (1 - np.cos(p)) / np.pi**2), rel=1e-5)
    assert float(limit_cost(bounded, jnp.array([0.9, -2.0]))) == pytest.approx((0.5**2 + 1) / 2, rel=1e-4)
    assert float(limit_cost(bounded, p)) == 0 and float(limit_cost(learner, jnp.array([3.1, 3.1]))) == 0


def planar_capsules():
    """Those of a planar arm with links of 0.4, 0.3 and 0.4 m."""
    start = np.array([[0.0, 0, 0], [0.4, 0, 0], [0.7, 0, 0]])
    return Capsules(start, start + np.array([[0.4, 0, 0], [0.3, 0, 0], [0.4, 0, 0]]), np.full(3, 0.03), (0, 1, 2))


def test_derivatives_equal_finite_differences(x64):
    """All costs of a pose together, of an arm with some of its capsules near each other and the floor."""
    expert = planar_arm([0.4, 0.3, 0.4])
    arm = dataclasses.replace(expert, joint_range=np.array([[-1.0, 1.0]] * 3), home=np.array([0.5, 0.9, 0.9]))
    capsules = planar_capsules()
    costs = Costs(1.0, 0.3, 0.2, self_collision=0.1, floor=0.1, clearance=0.5, floor_height=0.2)
    target, rng = jnp.asarray(arm.home), np.random.default_rng(1)
    cost = jax.jit(lambda q: pose_cost(costs, expert, arm, capsules, target, q))
    derivatives = jax.jit(lambda q: automatic_derivatives(cost, list(q)))
    for qpos in arm.home + rng.normal(size=(3, 3)) * 0.1:
        value, gradient, hessian = derivatives(qpos)
        assert value == pytest.approx(float(cost(qpos))) and value > 0.1
        step = 1e-6 * np.eye(3)
        numeric = [(cost(qpos + d) - cost(qpos - d)) / 2e-6 for d in step]
        np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-6)
        rows = [(np.array(derivatives(qpos + d)[1]) - np.array(derivatives(qpos - d)[1])) / 2e-6 for d in step]
        np.testing.assert_allclose(np.array(hessian), rows, rtol=1e-3, atol=1e-3)


def test_smoothness_derivatives_equal_automatic_ones(x64):
    costs, (p, e, q) = Costs(velocity=0.7, acceleration=0.3), np.random.default_rng(0).normal(size=(3, 4))
    ours = smoothness_derivatives(costs, list(q), p, e)
    theirs = automatic_derivatives(
        lambda q: jnp.mean(0.7 * (q - p) ** 2 + 0.3 * (q - 2 * p + e) ** 2), list(jnp.asarray(q))
    )
    assert ours.value == pytest.approx(float(theirs.value))
    np.testing.assert_allclose(ours.gradient, theirs.gradient)
    for i, row in enumerate(ours.hessian):
        np.testing.assert_allclose(row, theirs.hessian[i][: i + 1], atol=1e-12)


@pytest.mark.slow
def test_each_cost_of_a_pose_falls_where_it_has_a_weight():
    """And with it the sum of distance and cost: the optimum of the sum is below that of the distance alone."""
    bounded = dataclasses.replace(LEARNER, joint_range=np.array([[-1.0, 1.0], [-1.0, 1.0]]))
    plain = imitate_pose(EXPERT, bounded, QPOS, **METRIC, **FEW)
    for name in ("hand_position", "home", "limits"):
        costs = Costs(**{name: 10.0})

        def cost(q, p, costs=costs):
            return pose_cost(costs, EXPERT, bounded, None, q, p)

        result = imitate_pose(EXPERT, bounded, QPOS, **METRIC, **FEW, costs=costs)
        before, after = (np.asarray(jax.vmap(cost)(QPOS, solution.qpos)) for solution in (plain, result))
        assert after.mean() < 0.95 * before.mean(), name  # some hands are out of reach, at any weight
        total = np.asarray(result.distance) + after
        assert np.all(total <= np.asarray(plain.distance) + before + 1e-3), name  # the smoothing of positions


@pytest.mark.slow
def test_arms_do_not_intersect_themselves_or_the_floor():
    """A planar arm that folds back on itself; the floor is a plane that the default pose crosses."""
    expert = learner = planar_arm([0.4, 0.3, 0.4])
    metric = MetricConfig().build(expert, learner).arguments
    capsules = planar_capsules()
    folded = jnp.array([[0.0, 2.0, 1.9], [0.5, 2.2, 1.6]])

    def nearest(qpos):
        return jax.vmap(lambda q: pair_distances(capsules, *capsule_axes(learner, capsules, q)).min())(qpos)

    plain = imitate_pose(expert, learner, folded, **metric, **FEW)
    costs = Costs(self_collision=1.0)
    free = imitate_pose(expert, learner, folded, **metric, **FEW, costs=costs, capsules=capsules)
    assert np.all(np.asarray(nearest(plain.qpos)) < 0) and np.all(np.asarray(nearest(free.qpos)) > -0.002)
    high = Costs(floor=1.0, floor_height=-0.02)  # the arm is at height 0: -0.03 at its lower side
    value = pose_cost(high, expert, learner, capsules, folded[0], jnp.asarray(folded[0]))
    assert float(value) == pytest.approx(2 * (1 + 0.01 / 0.02) ** 2, rel=1e-4)


@pytest.mark.slow
def test_smoothness_reduces_velocity_and_acceleration():
    times = np.linspace(0, 1, 30)[:, None]
    qpos = (np.array([1.0, -1.5, 0.5]) * np.sin(6 * times) + 0.2 * np.sin(60 * times)).astype(np.float32)
    options = {**METRIC, "starts": 1, "largest_jump": 1.0}
    plain = imitate_trajectory(EXPERT, LEARNER, qpos, **options)
    for name, order in (("velocity", 1), ("acceleration", 2)):
        smooth = imitate_trajectory(EXPERT, LEARNER, qpos, **options, costs=Costs(**{name: 3.0}))
        sizes = [np.mean(np.diff(motion.qpos, order, axis=0) ** 2) for motion in (plain, smooth)]
        assert sizes[1] < 0.7 * sizes[0], name


@pytest.mark.usefixtures("unchecked")
def test_bad_costs_are_rejected():
    with pytest.raises(ValueError, match=r"costs\.home"):
        Costs(home=-1.0)
    with pytest.raises(ValueError, match="capsules: costs.self_collision and costs.floor need them"):
        imitate_pose(EXPERT, LEARNER, QPOS, **METRIC, costs=Costs(floor=1.0))
    with pytest.raises(ValueError, match="imitate_trajectory takes them"):
        imitate_pose(EXPERT, LEARNER, QPOS, **METRIC, costs=Costs(velocity=1.0))
