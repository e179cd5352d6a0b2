"""What a pose mapper to any arm is compared with: the optimum, random poses, and Newton steps without a network."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.any_arm.arrays import ArmArrays
from mimic.any_arm.kinematics import correspondence, link_states
from mimic.any_arm.nearest import nearest_pose
from mimic.any_arm.similarity import motion_similarity
from mimic.metric.kinematics import LinkStates
from mimic.trainers.pose_mapper.any_arm_model import AnyArmMapperModel, Params
from mimic.trainers.pose_mapper.any_arm_training import random_pose

# The optimum: Newton steps from this many random poses. A trained mapper may find a nearer pose than all of them, which
# then counts as the optimum.
_GUESSES, _STEPS = 64, 16
# What is compared, by the key of its quality in a report.
METHODS = ("quality", "quality_proposed", "quality_random_guesses", "quality_from_home")


class Reference(NamedTuple):
    """Poses without a network, for each arm and each pose of the expert.

    Attributes:
      optimal_distance, optimal_qpos: nearest of the poses after 16 Newton steps from 64 random initial guesses and
        home.
      guessed_distance, guessed_qpos: the same from as many guesses as the mapper has heads, with its Newton steps.
      home_distance: after the mapper's Newton steps from home.
      random_distance: mean of random poses.
    """

    optimal_distance: Float[Any, "arms poses"]
    optimal_qpos: Float[Any, "arms poses joints"]
    guessed_distance: Float[Any, "arms poses"]
    guessed_qpos: Float[Any, "arms poses joints"]
    home_distance: Float[Any, "arms poses"]
    random_distance: Float[Any, "arms poses"]


class Mapped(NamedTuple):
    """Poses of a mapper, for each arm and each pose of the expert.

    Attributes:
      distance, qpos: the mapper's result.
      proposed_distance: nearest of its proposals, before the Newton steps.
    """

    distance: Float[Any, "arms poses"]
    qpos: Float[Any, "arms poses joints"]
    proposed_distance: Float[Any, "arms poses"]


def make_reference(
    model: AnyArmMapperModel, key: Array, arms: ArmArrays, expert_qpos: Float[Array, "poses joints"]
) -> Reference:
    """Poses without a network.

    Args:
      model: defines expert, metric, number of heads and Newton steps.
      key: of the random initial guesses, which are the same for all poses of the expert.
      arms: learners, along the first axis.
      expert_qpos: poses of the expert [rad].
    """
    states = jax.vmap(lambda qpos: link_states(model.expert, qpos))(expert_qpos)

    def of_arm(arm: ArmArrays) -> Reference:
        guesses = jax.vmap(lambda key: random_pose(arm, key))(jax.random.split(key, max(_GUESSES, model.heads)))
        initial = jnp.concatenate([guesses, arm.home[None]])

        def of_pose(expert: LinkStates) -> Reference:
            path = _newton_path(model, expert, arm, initial, max(_STEPS, model.refinements))
            optimum = _nearest(model, expert, arm, path[-1])
            few_steps = path[model.refinements]
            guessed = _nearest(model, expert, arm, few_steps[: model.heads])
            home = model.distance(expert, arm, few_steps[-1])
            return Reference(*optimum, *guessed, home, model.distances(expert, arm, guesses).mean())

        return jax.vmap(of_pose)(states)

    return jax.lax.map(of_arm, arms)


def run_mapper(
    model: AnyArmMapperModel, params: Params, arms: ArmArrays, expert_qpos: Float[Array, "poses joints"]
) -> Mapped:
    """The mapper's poses for all arms and poses; see `make_reference`."""
    states = jax.vmap(lambda qpos: link_states(model.expert, qpos))(expert_qpos)

    def of_pose(arm: ArmArrays, expert: LinkStates) -> Mapped:
        proposed = model.candidates(params, expert, arm)
        path = _newton_path(model, expert, arm, proposed, model.refinements)
        return Mapped(*_nearest(model, expert, arm, path[-1]), model.distances(expert, arm, proposed).min())

    return jax.lax.map(lambda arm: jax.vmap(lambda state: of_pose(arm, state))(states), arms)


def _newton_path(
    model: AnyArmMapperModel, expert: LinkStates, arm: ArmArrays, initial: Float[Array, "n joints"], steps: int
) -> Float[Array, "steps n joints"]:
    """The initial poses, and the poses after each Newton step; one loop, which halves the time to compile."""
    matrix = correspondence(model.expert, arm)

    def step(poses: Array, _: None) -> tuple[Array, Array]:
        after = jax.vmap(lambda qpos: nearest_pose(arm, model.weights, matrix, expert, qpos, 1).qpos)(poses)
        return after, after

    _, path = jax.lax.scan(step, initial, None, length=steps)
    return jnp.concatenate([initial[None], path])


def _nearest(
    model: AnyArmMapperModel, expert: LinkStates, arm: ArmArrays, poses: Float[Array, "n joints"]
) -> tuple[Array, Array]:
    """The distance of the nearest pose, and the pose."""
    distances = model.distances(expert, arm, poses)
    nearest = jnp.argmin(distances)
    return distances[nearest], poses[nearest]


def best_distance(reference: Reference, mapped: Mapped) -> Float[np.ndarray, "arms poses"]:
    """Distances of the optimum: of the nearest pose that anything has found."""
    return np.minimum.reduce(
        [reference.optimal_distance, mapped.distance, reference.guessed_distance, reference.home_distance]
    )


def best_poses(reference: Reference, mapped: Mapped) -> Float[np.ndarray, "arms poses joints"]:
    """Poses of the optimum: the reference's, or the mapper's where those are nearer."""
    is_nearer = mapped.distance < reference.optimal_distance
    return np.where(is_nearer[..., None], mapped.qpos, reference.optimal_qpos)


def table_of_arms(reference: Reference, mapped: Mapped) -> dict[str, Float[np.ndarray, " arms"]]:
    """Columns of a table with one row for each arm, means over the poses.

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
    expert: ArmArrays,
    arms: ArmArrays,
    expert_qpos: Float[Any, "poses joints"],
    poses: Mapping[str, Float[Any, "arms poses joints"]],
) -> dict[str, dict[str, Float[np.ndarray, " arms"]]]:
    """Means over the poses of the measures of `mimic.metric.similarity`, as {method: {measure: [arms]}}."""
    measure = jax.jit(
        lambda qpos: jax.lax.map(lambda x: motion_similarity(expert, x[0], expert_qpos, x[1]), (arms, qpos))
    )
    return {
        name: {key: np.asarray(value).mean(axis=1, dtype=float) for key, value in measure(jnp.asarray(qpos)).items()}
        for name, qpos in poses.items()
    }
