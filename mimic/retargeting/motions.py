"""Motions of a learner that resemble those of an expert: a trajectory at a time, under a metric."""

import jax
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arm import rated_speed
from mimic.arms.embodiment import Embodiment
from mimic.metric.config import MetricConfig
from mimic.retargeting.pose import PoseImitation, imitate_trajectory


def largest_jump(arm: Embodiment, dt: float) -> Float[np.ndarray, " joints"]:
    """How far each joint goes in a time [s] at its rated speed [rad]."""
    return rated_speed(arm) * dt


def optimal_motions(
    expert: Embodiment, learner: Embodiment, qpos: Array, metric: MetricConfig, largest_jump: np.ndarray, seed: int
) -> PoseImitation:
    """The `imitate_trajectory` of each of an expert's motions [motions, time, joints] under a metric."""
    arguments = metric.build(expert, learner).arguments

    def one(qpos: jax.Array) -> PoseImitation:
        return imitate_trajectory(
            expert,
            learner,
            qpos,
            largest_jump=largest_jump,
            key=jax.random.key(seed),
            **arguments,
        )

    # One demonstration after the other: the minima that are tracked fill the processor, and memory stays small.
    return jax.jit(lambda all_qpos: jax.lax.map(one, all_qpos))(qpos)
