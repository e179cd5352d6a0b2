"""What a pose mapper is compared with: the optimum, random poses, and Newton steps without a network."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mimic.arms.arrays import ArmArrays
from mimic.metric.kinematics import link_states
from mimic.retargeting.pose import imitate_pose
from mimic.trainers.pose_mapper.model import MapperModel, Params
from mimic.trainers.pose_mapper.pair import Pair, Target, random_poses

# The optimum of arms as arrays: Newton steps from this many random poses and home. A trained mapper may find a nearer
# pose than all of them, which then counts as the optimum.
_GUESSES, _STEPS = 64, 16
# What is compared, by the key of its quality in a report; of one pair the first alone.
METHODS = ("quality", "quality_proposed", "quality_random_guesses", "quality_from_home")

MakeKey = Callable[[], Array]


class Pairs(NamedTuple):
    """Pairs of arms, along the first axis, and poses of each expert.

    Attributes:
      experts, learners: the arms as arrays; None for the one pair of the mapper.
      expert_qpos: [rad], with an angle for each slot of a joint; of the one pair without the axis of the pairs.
    """

    experts: ArmArrays | None
    learners: ArmArrays | None
    expert_qpos: Float[Any, "*pairs poses joints"]


class Reference(NamedTuple):
    """Poses without a network, for each pair of arms and each pose of the expert.

    Attributes:
      optimal_distance, optimal_qpos: the optimum; of arrays the nearest of the poses after 16 Newton steps from 64
        random initial guesses and home.
      random_distance: of a random pose; of arrays the mean of many.
      guessed_distance, guessed_qpos: of arrays: the nearest from as many other random guesses as the mapper has initial
        poses, with its Newton steps.
      home_distance: of arrays: after the mapper's Newton steps from home.
      expert_direction, optimal_direction: [pairs, poses, links, 3] of one pair: directions of the links.
    """

    optimal_distance: Float[Any, "pairs poses"]
    optimal_qpos: Float[Any, "pairs poses joints"]
    random_distance: Float[Any, "pairs poses"]
    guessed_distance: Any = None
    guessed_qpos: Any = None
    home_distance: Any = None
    expert_direction: Any = None
    optimal_direction: Any = None


class Mapped(NamedTuple):
    """Poses of a mapper, for each pair of arms and each pose of the expert.

    Attributes:
      distance, qpos: the mapper's result.
      proposed_distance: of arrays: the nearest of the poses of its heads, before the Newton steps.
      direction: [pairs, poses, links, 3] of one pair: directions of the learner's links.
    """

    distance: Float[Any, "pairs poses"]
    qpos: Float[Any, "pairs poses joints"]
    proposed_distance: Any = None
    direction: Any = None


def make_reference(model: MapperModel, make_key: MakeKey, pairs: Pairs) -> Reference:
    """Poses without a network.

    Args:
      model: defines metric, number of initial poses and Newton steps.
      make_key: random key of the random poses; of arrays these are the same for all poses of the expert.
      pairs: the arms and the experts' poses.
    """
    make = _reference_of_arrays if model.learner is None else _reference_of_one_pair
    return _over_pairs(lambda pair, qpos: make(model, pair, make_key, qpos), model, pairs)


def _over_pairs(function: Callable[[Pair, Array], Any], model: MapperModel, pairs: Pairs) -> Any:
    """A function of a pair and the poses of its expert, one pair after the other."""
    if model.learner is not None:
        return jax.tree.map(lambda x: x[None], function(model.pair(), pairs.expert_qpos))
    return jax.lax.map(lambda each: function(model.pair(each.learners, each.experts), each.expert_qpos), pairs)


def _reference_of_one_pair(model: MapperModel, pair: Pair, make_key: MakeKey, poses: Array) -> Reference:
    kept = None  # halves the time to compile
    solution = imitate_pose(pair.expert, pair.learner, poses, kept=kept, **pair.metric.arguments)
    distance = jax.vmap(lambda qpos, learner_qpos: pair.target(qpos).distance(learner_qpos))
    random = random_poses(pair.learner, make_key(), poses.shape[:1])
    expert_direction, random_distance = _directions(pair.expert, poses), distance(poses, random)
    direction = _directions(pair.learner, solution.qpos)
    return Reference(
        optimal_distance=distance(poses, solution.qpos),
        optimal_qpos=solution.qpos,
        random_distance=random_distance,
        expert_direction=expert_direction,
        optimal_direction=direction,
    )


def _directions(arm: Any, poses: Array) -> Array:
    directions = jax.vmap(lambda qpos: link_states(arm, qpos).direction)(poses)
    assert directions is not None
    return directions


def _reference_of_arrays(model: MapperModel, pair: Pair, make_key: MakeKey, poses: Array) -> Reference:
    arm, few = pair.learner, model.config.refinements
    guesses = jax.vmap(lambda key: random_poses(arm, key))(jax.random.split(make_key(), max(_GUESSES, model.starts)))
    initial = jnp.concatenate([guesses, arm.home[None]])

    def of_pose(qpos: Array) -> Reference:
        target = pair.target(qpos)
        path = _newton_path(target, initial, max(_STEPS, few))
        optimum, guessed = target.nearest(path[-1]), target.nearest(path[few][: model.starts])
        random, home = target.distances(guesses).mean(), target.distance(path[few][-1])
        return Reference(*optimum, random, *guessed, home)

    return jax.vmap(of_pose)(poses)


def _newton_path(target: Target, initial: Float[Array, "n joints"], steps: int) -> Float[Array, "steps n joints"]:
    """The initial poses, and the poses after each Newton step; one loop, which halves the time to compile."""

    def step(poses: Array, _: None) -> tuple[Array, Array]:
        after = target.improved(poses, 1)
        return after, after

    _, path = jax.lax.scan(step, initial, None, length=steps)
    return jnp.concatenate([initial[None], path])


def run_mapper(model: MapperModel, params: Params, pairs: Pairs) -> Mapped:
    """The mapper's poses for all pairs and poses; see `make_reference`."""

    def of_pair(pair: Pair, poses: Array) -> Mapped:
        def of_pose(qpos: Array) -> Mapped:
            target = pair.target(qpos)
            learner_qpos = model(params, target)
            if model.learner is not None:
                return Mapped(
                    target.distance(learner_qpos), learner_qpos, None, link_states(pair.learner, learner_qpos).direction
                )
            proposed = target.distances(model.candidates(params, target)).min()
            return Mapped(target.distance(learner_qpos), learner_qpos, proposed)

        return jax.vmap(of_pose)(poses)

    return _over_pairs(of_pair, model, pairs)


def best_distance(reference: Reference, mapped: Mapped) -> Float[np.ndarray, "pairs poses"]:
    """Distances of the optimum: of one pair the optimiser's, of arrays of the nearest pose that anything has found."""
    if reference.guessed_distance is None:
        return reference.optimal_distance
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
    means = {
        name: distance.mean(axis=1, dtype=float)
        for name, distance in zip(METHODS, distances, strict=True)
        if distance is not None
    }
    qualities = {name: (mean - optimum) / (random - optimum) for name, mean in means.items()}
    return {**qualities, "mean_distance": means[METHODS[0]], "optimal_distance": optimum, "random_distance": random}
