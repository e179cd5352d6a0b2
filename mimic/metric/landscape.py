"""The metric over all poses of a two-joint learner, and its local minima (paper, Fig. 2 d-f)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from mimic.arms.embodiment import Embodiment
from mimic.metric.distance import Correspondence, Metric, RotationMeasure, Weights
from mimic.metric.kinematics import link_states


class Landscape(NamedTuple):
    """Embodiment distance to one pose of the expert over a grid of the learner's angles.

    Attributes:
      angles: [k] grid of each joint in [-pi, pi) [rad].
      distance: [k, k] embodiment distance; rows are the first joint.
    """

    angles: Float[Array, " k"]
    distance: Float[Array, "k k"]


def distance_landscape(
    expert: Embodiment,
    learner: Embodiment,
    qpos: Float[ArrayLike, " expert_joints"],
    correspondence: Correspondence,
    weights: Weights,
    *,
    rotation: RotationMeasure = "cosine",
    resolution: int = 180,
) -> Landscape:
    """Embodiment distance between one pose of the expert and each pose of a two-joint learner on a grid.

    Args:
      expert: n joints.
      learner: two joints.
      qpos: [n] the expert's pose [rad].
      correspondence: see `embodiment_distance`.
      weights: see `embodiment_distance`.
      rotation: see `embodiment_distance`.
      resolution: number k of angles of each joint.

    Raises:
      ValueError: the learner does not have two joints, or the resolution is below 3.
    """
    if learner.num_joints != 2:
        raise ValueError(f"learner: expected 2 joints, got {learner.num_joints} of {learner.name}")
    if resolution < 3:
        raise ValueError(f"resolution: expected at least 3, got {resolution}")
    metric = Metric(correspondence, weights, rotation)
    states = link_states(expert, qpos)
    angles = jnp.linspace(-jnp.pi, jnp.pi, resolution, endpoint=False)

    def distance(first: Array, second: Array) -> Array:
        learner_states = link_states(learner, jnp.stack([first, second]))
        return metric(states, learner_states)

    over_grid = jax.vmap(jax.vmap(distance, (None, 0)), (0, None))
    return Landscape(angles, jax.jit(over_grid)(angles, angles))


def local_minima(distance: Float[ArrayLike, "k k"]) -> Int[np.ndarray, "minima 2"]:
    """Indices of the grid poses with a smaller distance than all eight neighbours; the grid is periodic."""
    values = np.asarray(distance)
    shifts = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    is_minimum = np.all([values < np.roll(values, shift, axis=(0, 1)) for shift in shifts], axis=0)
    return np.argwhere(is_minimum)
