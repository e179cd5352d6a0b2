"""Motions of a learner that resemble those of an expert under a metric, one trajectory at a time."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arm import finite_velocity_limit
from mimic.arms.embodiment import Embodiment
from mimic.metric.config import MetricConfig
from mimic.retargeting.pose import PoseImitation
from mimic.retargeting.trajectory import imitate_trajectory


def largest_jump(arm: Embodiment, dt: float) -> Float[np.ndarray, " joints"]:
    """Maximum change of each joint [rad] in a time [s], at its velocity limit."""
    return finite_velocity_limit(arm) * dt


def optimal_motions(
    expert: Embodiment,
    learner: Embodiment,
    qpos: Array,
    metric: MetricConfig,
    largest_jump: np.ndarray,
    seed: int,
    **costs: Any,
) -> PoseImitation:
    """`imitate_trajectory` of each of the expert's motions [motions, time, joints], with its `costs` and `capsules`."""
    arguments = metric.build(expert, learner).arguments

    def imitate(qpos: jax.Array) -> PoseImitation:
        return imitate_trajectory(
            expert,
            learner,
            qpos,
            largest_jump=largest_jump,
            key=jax.random.key(seed),
            **arguments,
            **costs,
        )

    # One demonstration after the other: the tracked minima already fill the processor, and memory stays small.
    return jax.jit(lambda all_qpos: jax.lax.map(imitate, all_qpos))(qpos)
