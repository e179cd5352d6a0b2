"""What a pose mapper is compared with: the optimum and random poses."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from mimic.metric.kinematics import link_states
from mimic.retargeting.pose import imitate_pose
from mimic.trainers.pose_mapper.model import MapperModel, Params, random_poses


class Reference(NamedTuple):
    """Poses without a network, for each pose of the expert.

    Attributes:
      distance, qpos: the optimum.
      random_distance: of a random pose.
      expert_direction, direction: [poses, links, 3] directions of the expert's links, and of the learner's at the
        optimum.
    """

    distance: Float[Any, " poses"]
    qpos: Float[Any, "poses learner_joints"]
    random_distance: Float[Any, " poses"]
    expert_direction: Float[Any, "poses links 3"]
    direction: Float[Any, "poses learner_links 3"]


class Mapped(NamedTuple):
    """Poses of a mapper, for each pose of the expert.

    Attributes:
      distance, qpos: the mapper's result.
      direction: [poses, links, 3] directions of the learner's links.
    """

    distance: Float[Any, " poses"]
    qpos: Float[Any, "poses learner_joints"]
    direction: Float[Any, "poses learner_links 3"]


def make_reference(model: MapperModel, key: Array, poses: Float[Array, "poses joints"]) -> Reference:
    """The optimum of poses of the expert [rad], and random poses of the learner.

    Args:
      model: defines arms and metric.
      key: random key of the random poses.
      poses: of the expert [rad].
    """
    expert, learner, kept = model.expert, model.learner, None  # kept: halves the time to compile
    solution = imitate_pose(expert, learner, poses, kept=kept, **model.metric.arguments)
    distance = jax.vmap(model.distance)
    return Reference(
        distance=distance(poses, solution.qpos),
        qpos=solution.qpos,
        random_distance=distance(poses, random_poses(learner, key, len(poses))),
        expert_direction=jax.vmap(lambda qpos: link_states(expert, qpos).direction)(poses),
        direction=jax.vmap(lambda qpos: link_states(learner, qpos).direction)(solution.qpos),
    )


def run_mapper(model: MapperModel, params: Params, poses: Float[Array, "poses joints"]) -> Mapped:
    """The mapper's poses of the learner for poses of the expert [rad]."""

    def of_pose(qpos: Array) -> Mapped:
        learner_qpos = model(params, qpos)
        direction = link_states(model.learner, learner_qpos).direction
        return Mapped(model.distance(qpos, learner_qpos), learner_qpos, direction)

    return jax.vmap(of_pose)(poses)


def mean_distances(reference: Reference, mapped: Mapped, part: slice) -> dict[str, float]:
    """Mean distances over a part of the poses, and `quality`: 0 is the optimum, 1 a random pose."""
    distances = mapped.distance, reference.distance, reference.random_distance
    mean, optimum, random = (float(np.mean(x[part], dtype=float)) for x in distances)
    return {
        "quality": (mean - optimum) / (random - optimum),
        "mean_distance": mean,
        "optimal_distance": optimum,
        "random_distance": random,
    }
