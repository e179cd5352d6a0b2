"""What a pose mapper to any arm is compared with: the optimum, random poses, and Newton steps without a network."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.metric.correspondence import arc_length_correspondence
from mimic.metric.similarity import motion_similarity
from mimic.retargeting.array_nearest import nearest_pose
from mimic.trainers.pose_mapper.any_arm_model import AnyArmMapperModel, ExpertPose, Params, expert_pose
from mimic.trainers.pose_mapper.any_arm_training import random_pose

# The optimum: Newton steps from this many random poses. A trained mapper may find a nearer pose than all of them, which
# then counts as the optimum.
_GUESSES, _STEPS = 64, 16
# What is compared, by the key of its quality in a report.
METHODS = ("quality", "quality_proposed", "quality_random_guesses", "quality_from_home")


class Pairs(NamedTuple):
    """Pairs of arms, along the first axis, and poses of each expert.

    Attributes:
      experts, learners: the arms.
      expert_qpos: [rad], an angle for each slot of a joint.
    """

    experts: ArmArrays
    learners: ArmArrays
    expert_qpos: Float[Any, "pairs poses joints"]


class Reference(NamedTuple):
    """Poses without a network, for each pair of arms and each pose of the expert.

    Attributes:
      optimal_distance, optimal_qpos: nearest of the poses after 16 Newton steps from 64 random initial guesses and
        home.
      guessed_distance, guessed_qpos: the same from as many other random guesses as the mapper has initial poses, with
        its Newton steps.
      home_distance: after the mapper's Newton steps from home.
      random_distance: mean of random poses.
    """

    optimal_distance: Float[Any, "pairs poses"]
    optimal_qpos: Float[Any, "pairs poses joints"]
    guessed_distance: Float[Any, "pairs poses"]
    guessed_qpos: Float[Any, "pairs poses joints"]
    home_distance: Float[Any, "pairs poses"]
    random_distance: Float[Any, "pairs poses"]


class Mapped(NamedTuple):
    """Poses of a mapper, for each pair of arms and each pose of the expert.

    Attributes:
      distance, qpos: the mapper's result.
      proposed_distance: nearest of the poses of its heads, before the Newton steps.
    """

    distance: Float[Any, "pairs poses"]
    qpos: Float[Any, "pairs poses joints"]
    proposed_distance: Float[Any, "pairs poses"]


def make_reference(model: AnyArmMapperModel, key: Array, pairs: Pairs) -> Reference:
    """Poses without a network.

    Args:
      model: defines metric, number of initial poses and Newton steps.
      key: of the random initial guesses, which are the same for all poses of the expert.
      pairs: the arms and the experts' poses.
    """

    def of_pair(pair: Pairs) -> Reference:
        arm = pair.learners
        guesses = jax.vmap(lambda key: random_pose(arm, key))(jax.random.split(key, max(_GUESSES, model.starts)))
        initial = jnp.concatenate([guesses, arm.home[None]])

        def of_pose(qpos: Array) -> Reference:
            expert = expert_pose(pair.experts, qpos)
            path = _newton_path(model, expert, arm, initial, max(_STEPS, model.refinements))
            optimum = _nearest(model, expert, arm, path[-1])
            few_steps = path[model.refinements]
            guessed = _nearest(model, expert, arm, few_steps[: model.starts])
            home = model.distance(expert, arm, few_steps[-1])
            return Reference(*optimum, *guessed, home, model.distances(expert, arm, guesses).mean())

        return jax.vmap(of_pose)(pair.expert_qpos)

    return jax.lax.map(of_pair, pairs)


def run_mapper(model: AnyArmMapperModel, params: Params, pairs: Pairs) -> Mapped:
    """The mapper's poses for all pairs and poses; see `make_reference`."""

    def of_pose(expert: ExpertPose, arm: ArmArrays) -> Mapped:
        poses, distances = model.refined(params, expert, arm)
        nearest = jnp.argmin(distances)
        proposed = model.distances(expert, arm, model.candidates(params, expert, arm))
        return Mapped(distances[nearest], poses[nearest], proposed.min())

    def of_pair(pair: Pairs) -> Mapped:
        return jax.vmap(lambda qpos: of_pose(expert_pose(pair.experts, qpos), pair.learners))(pair.expert_qpos)

    return jax.lax.map(of_pair, pairs)


def _newton_path(
    model: AnyArmMapperModel, expert: ExpertPose, arm: ArmArrays, initial: Float[Array, "n joints"], steps: int
) -> Float[Array, "steps n joints"]:
    """The initial poses, and the poses after each Newton step; one loop, which halves the time to compile."""
    matrix = arc_length_correspondence(expert.arm, arm)

    def step(poses: Array, _: None) -> tuple[Array, Array]:
        after = jax.vmap(lambda qpos: nearest_pose(arm, model.weights, matrix, expert.states, qpos, 1).qpos)(poses)
        return after, after

    _, path = jax.lax.scan(step, initial, None, length=steps)
    return jnp.concatenate([initial[None], path])


def _nearest(
    model: AnyArmMapperModel, expert: ExpertPose, arm: ArmArrays, poses: Float[Array, "n joints"]
) -> tuple[Array, Array]:
    """The distance of the nearest pose, and the pose."""
    distances = model.distances(expert, arm, poses)
    nearest = jnp.argmin(distances)
    return distances[nearest], poses[nearest]


def best_distance(reference: Reference, mapped: Mapped) -> Float[np.ndarray, "pairs poses"]:
    """Distances of the optimum: of the nearest pose that anything has found."""
    return np.minimum.reduce(
        [reference.optimal_distance, mapped.distance, reference.guessed_distance, reference.home_distance]
    )


def best_poses(reference: Reference, mapped: Mapped) -> Float[np.ndarray, "pairs poses joints"]:
    """Poses of the optimum: the reference's, or the mapper's where those are nearer."""
    is_nearer = mapped.distance < reference.optimal_distance
    return np.where(is_nearer[..., None], mapped.qpos, reference.optimal_qpos)


def table_of_pairs(reference: Reference, mapped: Mapped) -> dict[str, Float[np.ndarray, " pairs"]]:
    """Columns of a table with one row for each pair of arms, means over the poses.

    Each of `METHODS` is (distance - optimum) / (random - optimum): 0 is the optimum, 1 a random pose.
    """
    optimum, random = (
        x.mean(axis=1, dtype=float) for x in (best_distance(reference, mapped), reference.random_distance)
    )
    distances = mapped.distance, mapped.proposed_distance, reference.guessed_distance, reference.home_distance
    means = [distance.mean(axis=1, dtype=float) for distance in distances]
    qualities = {name: (mean - optimum) / (random - optimum) for name, mean in zip(METHODS, means, strict=True)}
    return {**qualities, "mean_distance": means[0], "optimal_distance": optimum, "random_distance": random}


def mean_similarity(
    pairs: Pairs, poses: Mapping[str, Float[Any, "pairs poses joints"]]
) -> dict[str, dict[str, Float[np.ndarray, " pairs"]]]:
    """Means over the learners' poses of the measures of `mimic.metric.similarity`, as {method: {measure: [pairs]}}."""
    measure = jax.jit(lambda qpos: jax.lax.map(lambda x: motion_similarity(*x), (*pairs, qpos)))
    return {
        name: {key: np.asarray(value).mean(axis=1, dtype=float) for key, value in measure(jnp.asarray(qpos)).items()}
        for name, qpos in poses.items()
    }
