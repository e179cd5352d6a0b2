"""Arms, states and all options of the metric, for the tests of its values and gradients."""

import functools

import jax
import numpy as np
from jax.typing import DTypeLike

from mimic.arms.embodiment import planar_arm
from mimic.metric.correspondence import hard_correspondence, overlap_correspondence, soft_correspondence
from mimic.metric.distance import DistanceWeights, Reduction, RotationMeasure, adaptive_weights
from mimic.metric.kinematics import link_states

ALL_WEIGHTS = DistanceWeights(translation=2.0, rotation=1.0, linear_velocity=3.0, angular_velocity=0.5)
SHAPE = (3, 2)  # links of the two arms that gradients are taken with
EXPERT, LEARNER = planar_arm([0.5, 0.3, 0.4]), planar_arm([0.8, 0.4])

CORRESPONDENCES = {
    "overlap": overlap_correspondence(EXPERT, LEARNER),
    "hard": hard_correspondence,
    "soft": functools.partial(soft_correspondence, xi=-3.0),
    "matrix": np.random.default_rng(0).uniform(0, 2, SHAPE),
}
WEIGHTS = {
    "constant": ALL_WEIGHTS,
    "matrix": DistanceWeights(translation=np.ones(SHAPE), rotation=np.linspace(0, 1, 6).reshape(SHAPE)),
    "adaptive": adaptive_weights,
}
MEASURES: tuple[RotationMeasure, ...] = ("cosine", "angle")
REDUCTIONS: tuple[Reduction, ...] = ("mean", "frobenius")


_link_states = jax.jit(link_states)


def states(arm, seed=0, dtype: DTypeLike = np.float32):
    rng = np.random.default_rng(seed)
    qpos, qvel = rng.uniform(-np.pi, np.pi, arm.num_joints), rng.uniform(-2, 2, arm.num_joints)
    return _link_states(arm, qpos.astype(dtype), qvel.astype(dtype))


def random_poses(arm, count, seed=0):
    """Poses [count, joints] within the limits of an arm."""
    lower, upper = np.asarray(arm.joint_range).T
    return np.random.default_rng(seed).uniform(lower, upper, (count, arm.num_joints)).astype(np.float32)


def planar_optimum(expert, learner, qpos):
    """Closed form of the minimum distance of directions, by overlap: [...] for poses [..., joints] of a planar expert.

    Each link of the learner points along the sum of the directions that correspond to it.
    """
    angles = np.cumsum(qpos, axis=-1)
    weights = np.asarray(overlap_correspondence(expert, learner))
    pull = np.abs(np.exp(1j * angles) @ weights)
    return np.pi / 2 * (weights.sum() - pull.sum(axis=-1)) / weights.size
